"""`clsplat bench`: the time of a training step."""

import json
from pathlib import Path

import click

from clsplat.cli.flags import PATH, FiniteRange, device_flag


@click.command()
@click.argument("scene", type=PATH)
@click.option("--gaussians", type=click.IntRange(0), default=0, show_default=True,
              help="How many; 0: as many as the scene has points.")
@click.option("-r", "--downscale", type=FiniteRange(min=1), default=1.0, show_default=True,
              help="Divide the size of the photos by this.")
@click.option("--profile", is_flag=True, help="Time each kernel as well.")
@click.option("--json", "as_json", is_flag=True, help="Print one line of JSON.")
@device_flag
def bench(scene: Path, gaussians: int, downscale: float, profile: bool, as_json: bool, device: str
          ) -> None:
    """Time the training steps of SCENE.

    The median is that of steps which are waited for one by one; host_ms is the time in which the
    host enqueues a step when nothing is waited for, and stream_ms that in which the device has done
    it too.
    """
    from clsplat.bench.step import table, time_steps
    from clsplat.device import choose_device
    record = time_steps(choose_device(device, profiling=profile), scene, gaussians, profile,
                        downscale=downscale)
    click.echo(json.dumps(record) if as_json else table(record))
