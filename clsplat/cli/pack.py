"""`clsplat pack`: a scene and its photos in one file."""

from contextlib import ExitStack
from pathlib import Path

import click

from clsplat.cli.flags import FiniteRange
from clsplat.errors import InputError


@click.command()
@click.argument("scene", type=click.Path(path_type=Path))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path),
              help="The file, .npz.")
@click.option("-r", "--downscale", type=FiniteRange(min=1), default=1.0, show_default=True,
              help="Divide width and height of the photos by this; at 1 they keep their bytes.")
@click.option("--images", default="", help="Folder of the photos, relative to SCENE; found there "
              "unless given.")
@click.option("--overwrite", is_flag=True, help="Replace a file that is there.")
def pack(scene, output, downscale, images, overwrite):
    """Put SCENE and its photos into one file, to be carried to another machine.

    Every command takes the file as it takes a scene's folder. The geometry of a synthetic city
    goes beside it, for `clsplat eval`.
    """
    from clsplat.evaluation.floaters import geometry_path
    from clsplat.io.atomic import replacing
    from clsplat.io.packed import write_packed
    from clsplat.io.scenes import read_scene
    if output.suffix != ".npz":
        raise InputError(f"{output}: a packed scene is told by its suffix; let --output end in "
                         ".npz")
    truth, beside = geometry_path(scene), geometry_path(output)
    for made in (output, beside) if truth.is_file() else (output,):
        if made.exists() and not overwrite:
            raise InputError(f"{made}: is there already; replace it with --overwrite, or choose "
                             "another --output")
    data = read_scene(scene, images)
    with ExitStack() as stack:
        if truth.is_file():
            content = truth.read_bytes()
            file = stack.enter_context(replacing(beside, content))
            file.write(content)
            file.flush()  # it has its space before the photos take the rest
        write_packed(data, output, downscale)
    click.echo(f"{output}: {len(data.views)} photos, {output.stat().st_size / 1e6:,.1f} MB")
