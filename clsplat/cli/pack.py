"""`clsplat pack`: a scene and its photos in one file."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import click

from clsplat.cli.flags import FiniteRange, check_free
from clsplat.errors import InputError


@click.command()
@click.argument("scene", type=click.Path(path_type=Path))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path),
              help="The new file, .npz.")
@click.option("-r", "--downscale", type=FiniteRange(min=1), default=1.0, show_default=True,
              help="Divide the width and height of the photos by this; with 1 their files are "
              "copied.")
@click.option("--images", default="", help="Folder of the photos, relative to SCENE; default: as "
              "for `clsplat train`.")
@click.option("--overwrite", is_flag=True, help="Replace an existing file.")
def pack(scene: Path, output: Path, downscale: float, images: str, overwrite: bool) -> None:
    """Pack SCENE and its photos into one file.

    Every command accepts this file in place of the scene's folder. The geometry of a synthetic city
    is written beside it, for `clsplat eval`.
    """
    from clsplat.evaluation.floaters import geometry_path
    from clsplat.io.atomic import replacing
    from clsplat.io.scenes.packed import write_packed
    from clsplat.io.scenes.read import read_scene
    if output.suffix != ".npz":
        raise InputError(f"{output}: the suffix of a packed scene is .npz; change --output")
    truth, beside = geometry_path(scene), geometry_path(output)
    for path in (output, beside) if truth.is_file() else (output,):
        check_free(path, overwrite)
    data = read_scene(scene, images)
    with ExitStack() as stack:
        if truth.is_file():
            content = truth.read_bytes()
            file = stack.enter_context(replacing(beside, content))
            file.write(content)
            file.flush()  # so that it has its space before the photos fill the disk
        write_packed(data, output, downscale)
    click.echo(f"{output}: {len(data.views)} photos, {output.stat().st_size / 1e6:,.1f} MB")
