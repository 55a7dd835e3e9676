"""`clsplat georeference`: a scene in metres and map coordinates."""

from pathlib import Path

import click

from clsplat.cli.flags import PATH, FiniteRange
from clsplat.errors import InputError


@click.command(short_help="Give SCENE metres and map coordinates.")
@click.argument("scene", type=PATH)
@click.option("-o", "--output", required=True, type=PATH, help="Folder of the new scene; photos are linked.")
@click.option(
    "--photos",
    type=PATH,
    help="Folder of the original photos, if those of SCENE have lost their GPS; the names must be the same.",
)
@click.option(
    "--gcp",
    type=PATH,
    help="File of ground control points in place of GPS: "
    "OpenDroneMap's gcp_list.txt, or CSV. Pixels are those of the photos of SCENE.",
)
@click.option(
    "--check-point",
    "check_points",
    multiple=True,
    metavar="NAME",
    help="A point of --gcp that takes no part, but tells the error; may be repeated.",
)
@click.option(
    "--crs",
    default="",
    help="Coordinate reference system in metres, such as EPSG:25832; default: that of --gcp, or the UTM zone.",
)
@click.option(
    "--up",
    nargs=3,
    type=FiniteRange(),
    help="X Y Z: the direction in SCENE that points up, for photos whose heights do not tell; default: estimated.",
)
def georeference(
    scene: Path,
    output: Path,
    photos: Path | None,
    gcp: Path | None,
    check_points: tuple[str, ...],
    crs: str,
    up: tuple[float, float, float] | None,
) -> None:
    """Turn and scale SCENE into metres, with x to the east, y to the north and z upwards.

    The GPS of the photos decides, or ground control points. SCENE must have a COLMAP model, whose
    shape is kept: to adjust the cameras to control points as well, use `clsplat sfm --gcp`.
    """
    if up is not None and not any(up):
        raise InputError("--up 0 0 0: is no direction; give one such as 0 0 1")
    from clsplat.io.georeference.scene_folder import georeference_scene

    placed = georeference_scene(scene, output, photos=photos, crs=crs, gcp=gcp, checks=check_points, up=up)
    known = placed.georeference
    assert known is not None  # else an InputError
    click.echo("\n".join(placed.notes))
    for warning in placed.warnings:
        click.echo(f"warning: {warning}", err=True)
    east, north, height = known.offset
    click.echo(f"{output}: {known.crs[:60]}, origin at east {east:.0f}, north {north:.0f}, height {height:.0f}")
