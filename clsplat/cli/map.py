"""`clsplat map`: the orthophoto, the surface, the terrain and the contour lines of a run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from clsplat.cli.flags import PATH, FiniteRange, check_free, device_flag, moved_scene_flag
from clsplat.errors import InputError

if TYPE_CHECKING:
    from clsplat.cli.progress import Progress
    from clsplat.evaluation.run import Run

MOST_UNSURE = 0.1  # of the heights, without a warning


@click.command("map")
@click.argument("run", type=PATH)
@click.option("-o", "--output", required=True, type=PATH, help="Folder for the files.")
@click.option(
    "--resolution",
    type=FiniteRange(0, min_open=True),
    help="Size of a pixel, metres; of a scene without georeference scene units. Default: as fine as the photos.",
)
@click.option(
    "--bounds",
    type=FiniteRange(),
    nargs=4,
    metavar="LEFT BOTTOM RIGHT TOP",
    help="Extent in the coordinates of the map; default: all that is covered.",
)
@click.option(
    "--contours",
    type=FiniteRange(0),
    help="Height between contour lines, in the same unit; 0: none. Default: about 15 lines.",
)
@click.option(
    "--terrain",
    type=FiniteRange(0, min_open=True),
    metavar="WIDTH",
    help="Write the terrain as well: the ground without objects up to WIDTH wide, in the "
    "same unit, such as the widest building.",
)
@click.option("--overwrite", is_flag=True, help="Replace the files of an earlier map.")
@moved_scene_flag
@device_flag
def map_command(
    run: Path,
    output: Path,
    resolution: float | None,
    bounds: tuple[float, float, float, float] | None,
    contours: float | None,
    terrain: float | None,
    overwrite: bool,
    scene: Path | None,
    device: str,
) -> None:
    """Draw RUN from straight above, as a map.

    Writes a true orthophoto, a surface model and its hillshade as GeoTIFF, with styles for QGIS,
    contour lines as GeoJSON, a preview, a report of the survey as PDF, a STAC item and a record;
    with --terrain also the ground without buildings and trees. Alpha is 0 in holes, and where
    fewer than two photos show the place. Heights that the model is unsure of are left out of the
    surface.
    """
    from clsplat.apps.map import sentences
    from clsplat.apps.map_files import FILES, ITEM
    from clsplat.cli.progress import Progress
    from clsplat.evaluation.run import Run

    for name in FILES:
        check_free(output / name, overwrite)
    opened = Run.open(run)
    if bounds is not None and not (bounds[0] < bounds[2] and bounds[1] < bounds[3]):
        raise InputError(
            f"--bounds {' '.join(f'{side:g}' for side in bounds)}: give left, bottom, "
            "right and top, with left below right and bottom below top"
        )
    with Progress() as progress:
        record = draw_map(
            opened, scene, output, device, progress, resolution, bounds, interval=contours, terrain=terrain
        )
    unit = "m" if opened.georeference is not None else "scene units"
    low, high = record["heights"]
    click.echo(
        f"{output}: {record['columns']:,} x {record['rows']:,} pixels of "
        f"{record['resolution']:g} {unit}, {record['covered']:.0%} covered, "
        f"{record['pits']:,} unsure heights left out, 98% of the heights "
        f"{low:.2f} to {high:.2f} {unit}, {record['crs'] or 'no georeference'}"
    )
    if "terrain" in record:
        click.echo(
            f"{output}: {record['terrain']['ground']:.0%} of the surface is ground; the "
            "terrain beneath the rest is interpolated"
        )
    for line in sentences(record, unit):
        click.echo(f"{output}: {line}")
    if record["crs"] and ITEM not in record["files"]:
        click.echo(f"{output}: no {ITEM}, as no photo's file tells when it was taken")
    known = record["covered"] * record["columns"] * record["rows"]
    unsure = record["pits"] / (record["pits"] + known)
    if unsure > MOST_UNSURE:
        click.echo(
            f"{output}: warning: {unsure:.0%} of the heights are unsure and left out; train "
            "longer, or expect gaps where photos show little or repeated texture"
        )


def draw_map(
    run: Run,
    scene: Path | None,
    output: Path,
    device: str,
    progress: Progress,
    resolution: float | None = None,
    bounds: tuple[float, float, float, float] | None = None,
    **options: Any,
) -> dict[str, Any]:
    """Write the map of a run, whose scene may have been moved, and return its record; the others
    are arguments of `map_grid` and of `write_map`."""
    from clsplat.apps.map import write_map
    from clsplat.apps.map_grid import map_grid
    from clsplat.device import choose_device

    whole = replace(run.scene(scene, whole=True).with_up(run.up), georeference=run.georeference)
    data = run.as_trained(whole)
    grid = map_grid(data, resolution, bounds)
    progress.phase("opening the device")
    return write_map(
        run, data, grid, choose_device(device), output, follow=bounds is None, whole=whole, progress=progress, **options
    )
