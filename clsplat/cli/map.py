"""`clsplat map`: the orthophoto, the surface model and the contour lines of a run."""

from __future__ import annotations

import math
import re
from pathlib import Path

import click

from clsplat.cli.flags import Parsed, check_free, device_flag, moved_scene_flag
from clsplat.errors import InputError

MOST_FILLED = 50  # pixels, the widest hole that is filled
MOST_UNSURE = 0.1  # of the heights, without a warning
METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "km": 1e3}


def length_of(text: str) -> tuple[float, bool]:
    """A length of 0 or more, and whether it is in metres: a number alone is not known to be."""
    match = re.fullmatch(r"\s*([0-9.eE+-]+)\s*(mm|cm|m|km)?\s*", text)
    try:
        number = float(match[1]) if match else math.nan
    except ValueError:
        number = math.nan
    if not (match and 0 <= number < math.inf):
        raise ValueError("not a length; give a number, or one with a unit, such as 5cm")
    return (number * METRES[match[2]], True) if match[2] else (number, False)


LENGTH = Parsed("LENGTH", length_of)


@click.command("map")
@click.argument("run", type=click.Path(path_type=Path))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path),
              help="Folder for the files.")
@click.option("--resolution", type=LENGTH,
              help="Size of a pixel, such as 5cm; of a scene without georeference a number of "
              "scene units. Default: as fine as the photos.")
@click.option("--bounds", type=float, nargs=4, metavar="LEFT BOTTOM RIGHT TOP",
              help="Extent in the coordinates of the map; default: all that is covered.")
@click.option("--contours", type=LENGTH, help="Height between contour lines, "
              "such as 50cm, 0 for none. Default: about 15 lines.")
@click.option("--fill", type=click.IntRange(0, MOST_FILLED), default=0, show_default=True,
              help="Fill holes of at most so many pixels across.")
@click.option("--overwrite", is_flag=True, help="Replace the files of an earlier map.")
@moved_scene_flag
@device_flag
def map_command(run: Path, output: Path, resolution: tuple[float, bool] | None,
                bounds: tuple[float, float, float, float] | None,
                contours: tuple[float, bool] | None, fill: int, overwrite: bool,
                scene: Path | None, device: str) -> None:
    """Draw RUN from straight above, as a map.

    Writes a true orthophoto and a surface model as GeoTIFF, contour lines as GeoJSON, a preview
    and a record. Alpha is 0 in holes, and where fewer than two photos show the
    place. Heights that the model is unsure of are left out of the surface.
    """
    from dataclasses import replace

    from clsplat.apps.map import FILES, sentences, write_map
    from clsplat.apps.map_grid import map_grid
    from clsplat.cli.progress import Progress
    from clsplat.device import choose_device
    from clsplat.evaluation.run import Run
    for name in FILES:
        check_free(output / name, overwrite)
    opened = Run.open(run)
    place = opened.georeference
    data = replace(opened.scene(scene).with_up(opened.up), georeference=place)
    metric = place is not None
    size = _units("--resolution", resolution, metric)
    if size == 0:
        raise InputError("--resolution 0: give the size of a pixel, such as 5cm")
    if bounds is not None and not (bounds[0] < bounds[2] and bounds[1] < bounds[3]
                                   and all(map(math.isfinite, bounds))):
        raise InputError(f"--bounds {' '.join(f'{side:g}' for side in bounds)}: give left, bottom, "
                         "right and top, with left below right and bottom below top")
    interval = _units("--contours", contours, metric)
    grid = map_grid(data, size, bounds)
    with Progress() as progress:
        progress.phase("opening the device")
        chosen = choose_device(device)
        record = write_map(opened, data, grid, chosen, output, interval=interval, fill=fill,
                           follow=bounds is None,
                           count=progress.count, phase=progress.phase)
    unit = "m" if metric else "scene units"
    low, high = record["heights"]
    changed = f", {record['filled']:,} filled" if fill else ""
    click.echo(f"{output}: {record['columns']:,} x {record['rows']:,} pixels of "
               f"{record['resolution']:g} {unit}, {record['covered']:.0%} covered, "
               f"{record['pits']:,} unsure heights left out{changed}, 98% of the heights "
               f"{low:.2f} to {high:.2f} {unit}, {record['crs'] or 'no georeference'}")
    for line in sentences(record, unit):
        click.echo(f"{output}: {line}")
    known = record["covered"] * record["columns"] * record["rows"]
    unsure = record["pits"] / (record["pits"] + known)
    if unsure > MOST_UNSURE:
        click.echo(f"{output}: warning: {unsure:.0%} of the heights are unsure and left out; train "
                   "longer, or expect gaps where photos show little or repeated texture")


def _units(flag: str, length: tuple[float, bool] | None, metric: bool) -> float | None:
    """A length, as `length_of` returns it, in map units."""
    if length is None:
        return None
    number, in_metres = length
    if in_metres and not metric:
        raise InputError(f"{flag}: the scene has no georeference, so how long its unit is is "
                         "unknown; give a number of scene units, without m or cm")
    return number
