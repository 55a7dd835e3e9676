"""`clsplat render`: pictures of a model from a scene's cameras."""

from __future__ import annotations

from pathlib import Path

import click

from clsplat.cli.flags import FiniteRange, device_flag
from clsplat.errors import InputError


@click.command()
@click.argument("model", metavar="RUN_OR_FILE", type=click.Path(path_type=Path))
@click.option("--scene", type=click.Path(path_type=Path),
              help="Scene whose cameras to use; default for a run: its own scene.")
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path),
              help="Folder for the PNG files.")
@click.option("--views", type=click.Choice(("all", "test", "train")), default="all",
              show_default=True, help="Which views of the scene to render.")
@click.option("--beside", is_flag=True, help="Put each render beside its photo.")
@click.option("--lod", is_flag=True, help="Draw distant parts at coarser levels of detail; needs a "
              "run that was trained with --snapshots.")
@click.option("--lod-bias", type=FiniteRange(0, 1e6, min_open=True), default=1.0,
              show_default=True, help="With --lod: multiply distances by this when choosing the "
              "levels; more than 1 is coarser.")
@device_flag
def render(model: Path, scene: Path | None, output: Path, views: str, beside: bool, lod: bool,
           lod_bias: float, device: str) -> None:
    """Render a run, or a file of gaussians, from the cameras of a scene."""
    from functools import partial

    from clsplat.device import choose_device
    from clsplat.evaluation.run import Run, to_render
    from clsplat.evaluation.views import opened, render_view, render_views
    if lod_bias != 1 and not lod:
        raise InputError("--lod-bias: has no effect without --lod; add --lod, or leave this out")
    run = Run.open(model) if lod else None
    gaussians, data, options = to_render(model, scene)
    train, test = data.split(options.test_every, options.test_offset)
    chosen = {"all": data.views, "train": train, "test": test}[views]
    if not chosen:
        raise InputError(f"{data.name}: has no {views} views; choose others with --views")
    if run is None:
        draw = partial(render_view, *opened(choose_device(device), gaussians, data, options))
        render_views(draw, chosen, output, beside)
    else:
        from clsplat.city.lod import Detail
        detail = Detail(run, data, choose_device(device), lod_bias)
        render_views(detail.draw, chosen, output, beside)
        share = detail.drawn / (len(chosen) * gaussians.count)
        click.echo(f"{share:.1%} of {gaussians.count:,} gaussians drawn, mean of the views")
    click.echo(f"{len(chosen)} pictures: {output}")
