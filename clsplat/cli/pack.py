"""`clsplat pack`: a scene with its photos in a folder of its own."""

from pathlib import Path

import click

from clsplat.cli.flags import PATH, FiniteRange


@click.command()
@click.argument("scene", type=PATH)
@click.option("-o", "--output", required=True, type=PATH, help="The new folder.")
@click.option(
    "-r",
    "--downscale",
    type=FiniteRange(min=1),
    default=1.0,
    show_default=True,
    help="Divide the width and height of the photos by this; with 1 their files are copied.",
)
@click.option("--images", default="", help="Folder of the photos, relative to SCENE; default: as for `clsplat train`.")
def pack(scene: Path, output: Path, downscale: float, images: str) -> None:
    """Copy SCENE of any format into a folder that has all it needs.

    It is a COLMAP model with its photos, masks and depth maps, which can be carried to another
    machine.
    """
    from clsplat.io.folders import new_folder
    from clsplat.io.scenes.read import read_scene
    from clsplat.io.scenes.write import write_scene

    data = read_scene(scene, images)
    with new_folder(output) as folder:
        write_scene(folder, data, downscale, linked=False)
    size = sum(path.stat().st_size for path in output.rglob("*") if path.is_file())
    click.echo(f"{output}: {len(data.views)} photos, {size / 1e6:,.1f} MB")
