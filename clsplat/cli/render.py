"""`clsplat render`: pictures of a model from a scene's cameras."""

from pathlib import Path

import click


@click.command()
@click.argument("model", metavar="RUN_OR_PLY", type=click.Path(path_type=Path))
@click.option("--scene", type=click.Path(path_type=Path),
              help="Scene whose cameras to use; a run knows its own.")
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path),
              help="Folder for the PNG files.")
@click.option("--views", type=click.Choice(("all", "test", "train")), default="all",
              show_default=True, help="Which views of the scene.")
@click.option("--beside", is_flag=True, help="Put each render beside its photo.")
@click.option("--device", default="auto", show_default=True,
              help="auto, cpu, gpu, a number of `clsplat devices`, or part of a name.")
def render(model, scene, output, views, beside, device):
    """Render a run or a PLY file from the cameras of a scene."""
    from clsplat.device import choose_device
    from clsplat.evaluate.views import render_views
    count = render_views(model, scene, output, choose_device(device), views=views, beside=beside)
    click.echo(f"{count} pictures: {output}")
