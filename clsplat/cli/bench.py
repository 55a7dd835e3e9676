"""`clsplat bench`: the timings of one kernel family."""

from __future__ import annotations

from pathlib import Path

import click

from clsplat.cli.flags import FiniteRange, Parsed, device_flag
from clsplat.errors import InputError
from clsplat.options import TrainOptions


def _counts(text: str) -> tuple[int, ...]:
    from clsplat.bench.measure import counts
    return counts(text)


@click.command()
@click.argument("family", required=False)
@click.option("--gaussians", type=Parsed("COUNTS", _counts), default="200k", show_default=True,
              help="Numbers of gaussians, such as 200k,1M,4M.")
@click.option("--form", type=click.Choice(("auto", "item", "group")), default="auto",
              show_default=True, help="The form of the kernels.")
@click.option("--repeats", type=click.IntRange(1), default=20, show_default=True,
              help="How often each is timed; of `step`, once for each view.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON, one record a line.")
@click.option("--scene", type=click.Path(path_type=Path), help="Of `step`: a scene in place of the "
              "made city; 0 gaussians are as many as its points.")
@click.option("--downscale", type=FiniteRange(min=1), help="Of `step`: as for `clsplat train`.")
@click.option("--optimizer", type=click.Choice(("sparse", "dense")),
              help=f"Of `step`: as for `clsplat train`; default: {TrainOptions.optimizer}.")
@click.option("--profile", is_flag=True, default=None, help="Of `step`: time each kernel.")
@device_flag
def bench(family: str | None, gaussians: tuple[int, ...], form: str, repeats: int, as_json: bool,
          device: str, **of_step: object) -> None:
    """Time the kernels of a FAMILY; without FAMILY, list all.

    `step` is a whole step of a training, `render` a frame and its adjoint.
    """
    from clsplat.bench import families, run
    from clsplat.bench.measure import Bench
    from clsplat.device import choose_device
    if family is None:
        click.echo("\n".join(families()))
        return
    if family not in families():
        raise InputError(f"unknown benchmark '{family}'; known: {', '.join(families())}")
    given = {name: value for name, value in of_step.items() if value is not None}
    if given and family != "step":
        raise InputError(f"--{next(iter(given))}: is for `clsplat bench step` only; leave it out")
    opened = choose_device(device, form=form, profiling="profile" in given)
    run(family, Bench(opened, gaussians, repeats, as_json), **given)
