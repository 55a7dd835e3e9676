"""`clsplat bench`: the time of a training step, and `clsplat bench tune`: with other sizes."""

import json
from pathlib import Path

import click

from clsplat.cli.flags import PATH, FiniteRange, device_flag

scene_argument = click.argument("scene", type=PATH)
gaussians_flag = click.option(
    "--gaussians",
    type=click.IntRange(0),
    default=0,
    show_default=True,
    help="How many; 0: as many as the scene has points.",
)
downscale_flag = click.option(
    "-r",
    "--downscale",
    type=FiniteRange(min=1),
    default=1.0,
    show_default=True,
    help="Divide the size of the photos by this.",
)


@click.command()
@scene_argument
@gaussians_flag
@downscale_flag
@click.option("--profile", is_flag=True, help="Time each kernel as well.")
@click.option("--json", "as_json", is_flag=True, help="Print one line of JSON.")
@device_flag
def bench(scene: Path, gaussians: int, downscale: float, profile: bool, as_json: bool, device: str) -> None:
    """Time the training steps of SCENE.

    The median is that of steps which are waited for one by one; host_ms is the time in which the
    host enqueues a step when nothing is waited for, and stream_ms that in which the device has done
    it too.
    """
    from clsplat.bench.step import table, time_steps
    from clsplat.device import choose_device

    record = time_steps(choose_device(device, profiling=profile), scene, gaussians, profile, downscale=downscale)
    click.echo(json.dumps(record) if as_json else table(record))


@click.command("bench tune")
@scene_argument
@click.option(
    "-o", "--output", type=PATH, help="File for the sizes, if they are faster. Its rows of other devices stay."
)
@gaussians_flag
@downscale_flag
@click.option(
    "--turns",
    type=click.IntRange(3),
    default=15,
    show_default=True,
    help="How often each size is timed, by turns with the present one.",
)
@device_flag
def tune(scene: Path, output: Path | None, gaussians: int, downscale: float, turns: int, device: str) -> None:
    """Find sizes of kernels that are faster on a device.

    Training steps of SCENE are timed with one other size at a time. What is faster by more than the
    spread is kept, measured again as a whole, and written after a self-test. Set the environment
    variable CLSPLAT_TUNING to the file, and every command uses its sizes on devices that report the
    same type, wave, compute units and local memory.
    """
    from clsplat.bench.tune import ALL, HEADING, rows_in, steps_of, trials, write_row
    from clsplat.device import choose_device
    from clsplat.device.tuning import TUNING

    if output:
        rows_in(output)  # a file of something else is refused before minutes of measurement
    opened, last = choose_device(device), None
    click.echo(HEADING)
    for last in trials(opened, steps_of(opened, scene, gaussians, downscale=downscale), turns):
        click.echo(last.line())
    if last is None or last.name != ALL or not last.faster:
        click.echo(f"{opened.name}: no other sizes are faster by more than the spread; nothing is written")
        return
    if output is None:
        click.echo(f"write the faster sizes with -o FILE: {json.dumps(last.new)}")
        return
    write_row(output, opened, last.new)
    click.echo(f"the self-test passes with these sizes; use them with {TUNING}={output.resolve()}")
