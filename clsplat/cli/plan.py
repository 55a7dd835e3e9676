"""`clsplat plan`: the decisions of a training, and a forecast of its memory and time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from clsplat.cli.flags import PATH, TrainingCommand, config_options, given_options, training_flags
from clsplat.errors import InputError
from clsplat.schedule.plan import size_at

if TYPE_CHECKING:
    from clsplat.device import Device
    from clsplat.estimate.forecast import Forecast

MIB = 2**20
NAME_WIDTH = 12  # characters
MOST_PHOTOS = 10**9


@click.command(cls=TrainingCommand)
@click.argument("scene", type=PATH)
@click.option(
    "--photos",
    default="",
    help="Also forecast scenes with these numbers of photos like those of SCENE, such as 172,1000,100000.",
)
@click.option(
    "--workers",
    type=click.IntRange(1, MOST_PHOTOS),
    default=1,
    show_default=True,
    help="With --photos: number of devices.",
)
@training_flags
@click.pass_context
def plan(ctx: click.Context, /, scene: Path, photos: str, workers: int, **_options: object) -> None:
    """Forecast the decisions, memory and time of a training.

    Takes the options of `clsplat train`. Prints a line for each part of the training that can be
    left out, with the decision and its reason; the part's own flag overrides the decision. Then it
    takes a few real steps, and prints the largest memory on the device and the time.
    """
    from clsplat.cli.progress import Progress
    from clsplat.device import choose_device
    from clsplat.estimate.forecast import forecast
    from clsplat.io.scenes.read import read_scene
    from clsplat.options import resolve
    from clsplat.training.photos import size_note
    from clsplat.training.start.prepare import prepare

    options = resolve(config_options(ctx), given_options(ctx))
    counts, progress = _numbers(photos), Progress()
    with progress:
        progress.phase("reading the scene")
        data = read_scene(scene, options.images)
        device = choose_device(options.device, form=options.form)
        progress.phase("planning: inspecting the photos")
        prepared = prepare(data, options, device)
    click.echo(
        f"{data.name}: {len(prepared.train_views)} photos to train on, "
        f"{len(prepared.test_views)} held out, {len(data.points):,} points; {device.name}"
    )
    if note := size_note(data.views, options):
        click.echo(f"  {note}")
    for name, reason in prepared.decisions.reasons.items():
        _line(name, reason)
    with progress:
        found = forecast(prepared, device, progress)
    _line("photos", found.photos)
    _line("memory", _memory(found, device))
    _line("time", _time(found))
    if counts:
        from clsplat.cities.run import scale_table

        click.echo(f"\n{scale_table(prepared, options, found, device, counts, workers).text()}")


def _numbers(text: str) -> list[int]:
    try:
        numbers = [int(word) for word in text.split(",")] if text else []
        if min(numbers, default=1) < 1 or max(numbers, default=1) > MOST_PHOTOS:
            raise ValueError
    except ValueError:
        raise InputError(
            f"--photos {text[:80]}: expects whole numbers from 1 to {MOST_PHOTOS:,}, such as 1000,10000,100000"
        ) from None
    return numbers


def _line(name: str, text: str) -> None:
    click.echo(f"  {name.replace('_', ' '):<{NAME_WIDTH}}  {text}")


def _memory(forecast: Forecast, device: Device) -> str:
    memory, available = forecast.memory, device.memory_limit
    text = (
        f"{memory.total / MIB:,.0f} MiB at most, of {available / MIB:,.0f}: "
        f"{forecast.gaussians:,} gaussians {memory.model / MIB:,.0f}, photos "
        f"{memory.photos / MIB:,.0f}, the rest for the step"
    )
    if memory.waits:
        return f"{text}; {memory.waits / MIB:,.0f} MiB of harmonics wait in host memory"
    return text if memory.total < available else f"{text}; does not fit: use --max-gaussians or -r"


def _time(forecast: Forecast) -> str:
    from clsplat.cli.progress import clock

    (_, _, begin), (level, gaussians, end) = forecast.ends
    return (
        f"about {clock(forecast.seconds)} for {forecast.steps:,} steps: a step takes "
        f"{1e3 * begin:.1f} ms at first, and {1e3 * end:.1f} ms at the end, with photos at "
        f"{size_at(level)} and {gaussians:,} gaussians"
    )
