"""`clsplat render`: pictures of a model from a scene's cameras."""

from pathlib import Path

import click

from clsplat.cli.flags import PATH, device_flag, host_bytes, host_memory_flag
from clsplat.errors import InputError


@click.command(short_help="Render a model from the cameras of a scene.")
@click.argument("model", metavar="RUN_OR_FILE", type=PATH)
@click.option("--scene", type=PATH, help="Scene whose cameras to use; default for a run: its own scene.")
@click.option("-o", "--output", required=True, type=PATH, help="Folder for the PNG files.")
@click.option(
    "--views",
    type=click.Choice(("all", "test", "train")),
    default="all",
    show_default=True,
    help="Which views of the scene to render.",
)
@click.option("--beside", is_flag=True, help="Put each render beside its photo.")
@host_memory_flag
@device_flag
def render(
    model: Path, scene: Path | None, output: Path, views: str, beside: bool, host_memory: int | None, device: str
) -> None:
    """Render a run, or a file of gaussians, from the cameras of a scene.

    A city that was merged with --tree is read in parts, and need not fit memory.
    """
    from clsplat.device import choose_device
    from clsplat.evaluation.run import Run, has_tree, open_tree, scene_of_views, to_render
    from clsplat.evaluation.views import opened, render_view, render_views

    run = Run.open(model) if model.is_dir() else None
    most = host_bytes(host_memory, model)
    if not (run and has_tree(run)):
        gaussians, data, options = to_render(model, scene)
        renderer, rows, degree = opened(choose_device(device), gaussians, data, options)
        away = gaussians.offset - data.offset
    else:
        options = run.options
        data = scene_of_views(run, scene).reduced(options.downscale, options.max_resolution)
        renderer, rows = open_tree(run, choose_device(device), data.near(options.near), most)
        degree, away = rows.sh_degree, rows.offset - data.offset
    train, test = data.split(options.test_every, options.test_offset)
    chosen = {"all": data.views, "train": train, "test": test}[views]
    if not chosen:
        raise InputError(f"{data.name}: has no {views} views; choose others with --views")
    render_views(lambda camera: render_view(renderer, rows, degree, camera.shifted(away)), chosen, output, beside)
    click.echo(f"{len(chosen)} pictures: {output}")
