"""`clsplat measure`: lengths, areas and volumes on the surface of a map."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import click

from clsplat.cli.flags import PATH, Parsed, check_free, device_flag, moved_scene_flag

LENGTHS = "length", "surface_length", "lowest", "mean", "highest"
VOLUMES = "above", "below", "volume", "fill", "cut", "net", "net_noise"
HEADS = {"surface_length": "along surface", "net_noise": "noise of net"}


def parsed_base(text: str) -> str | float:
    """A word of BASES, or a finite height."""
    from clsplat.apps.measure import BASES

    if text in BASES:
        return text
    try:
        height = float(text)
    except ValueError:
        height = float("nan")
    if not abs(height) < float("inf"):
        raise ValueError(f"none of {', '.join(BASES)}, nor a height")
    return height


@click.command()
@click.argument("surface", type=PATH)
@click.option(
    "--geojson",
    required=True,
    type=PATH,
    help="File of lines and polygons, in longitude and latitude or in the coordinates of the map.",
)
@click.option("-o", "--output", required=True, type=PATH, help="Folder for the files.")
@click.option(
    "--base",
    type=Parsed("[fit|lowest|mean|HEIGHT]", parsed_base),
    default="fit",
    show_default=True,
    help="What volumes of polygons lie above: the plane that fits the "
    "surface along the border best, the level of its lowest or mean height, or a height.",
)
@click.option(
    "--before",
    type=PATH,
    help="An earlier surface of the same place; polygons then have the volumes that came and went since.",
)
@click.option("--overwrite", is_flag=True, help="Replace the files of earlier measurements.")
@moved_scene_flag
@device_flag
def measure(
    surface: Path,
    geojson: Path,
    output: Path,
    base: str | float,
    before: Path | None,
    overwrite: bool,
    scene: Path | None,
    device: str,
) -> None:
    """Measure lines and polygons on SURFACE.

    SURFACE is a GeoTIFF of heights, the folder of a map, or a run, whose map is then drawn. Lines
    have their length, along the surface as well, and a profile; polygons have their area, heights
    and volumes. Writes JSON and CSV.
    """
    from clsplat.apps.geotiff import read_surface
    from clsplat.apps.measure import FILES, write_measurements
    from clsplat.apps.measure import measure as measured
    from clsplat.io.georeference.geojson import read_features

    for name in FILES:
        check_free(output / name, overwrite)
    with surface_file(surface, scene, device) as late:
        early = None if before is None else stored_surface(before)
        features = read_features(geojson, read_surface(late).crs)
        result = measured(late, features, base, early)
    result.record["surface"] = str(surface)
    write_measurements(result, output)
    click.echo(_table(result.record))
    click.echo(
        f"{output}: {len(features)} feature{'s' if len(features) != 1 else ''}, "
        f"{result.record['crs'] or 'no georeference'}"
    )


def stored_surface(path: Path) -> Path:
    """The surface in the folder of a map, or a file."""
    from clsplat.apps.map_files import SURFACE

    return path / SURFACE if (path / SURFACE).is_file() else path


@contextmanager
def surface_file(path: Path, scene: Path | None, device: str) -> Iterator[Path]:
    """The surface of the folder of a map, of a file, or of a run, which is drawn for it."""
    from clsplat.cli.map import draw_map
    from clsplat.cli.progress import Progress
    from clsplat.evaluation.run import Run

    if not (file := stored_surface(path)).is_dir():
        yield file
        return
    with TemporaryDirectory() as folder:
        with Progress() as progress:
            draw_map(Run.open(path), scene, Path(folder), device, progress, interval=0)
        yield stored_surface(Path(folder))


def _table(record: dict[str, Any]) -> str:
    """What the terminal shows of measurements."""
    from clsplat.report.page import Table

    unit = "m" if record["crs"] else "units"
    units = {**dict.fromkeys(LENGTHS, unit), "area": f"{unit}²", **dict.fromkeys(VOLUMES, f"{unit}³")}
    keys = [
        "name",
        "kind",
        *(
            key
            for key in ("length", "surface_length", "area", "lowest", "mean", "highest", *VOLUMES, "known", "compared")
            if any(key in row for row in record["features"])
        ),
    ]
    heads = [f"{HEADS.get(key, key)}{f', {units[key]}' if key in units else ''}" for key in keys]
    rows = [[_cell(key, row.get(key)) for key in keys] for row in record["features"]]
    notes = [f"base of volumes: {record['base']}"]
    if "noise" in record:
        notes += [
            f"noise of single heights {record['noise']:.3f} {unit} (NMAD outside of the "
            f"polygons), level of detection {record['level_of_detection']:.3f} {unit}: fill "
            "and cut count what is beyond it, net counts all; outside of the polygons the "
            f"surfaces differ by {round(record['offset'], 3) + 0:.3f} {unit} in the median"
        ]
    return Table("", heads, rows, range(2, len(keys)), notes).text().lstrip("\n")


def _cell(key: str, value: Any) -> str:
    if value is None or isinstance(value, str):
        return value or ""
    return f"{value:.0%}" if key in ("known", "compared") else f"{value:,.2f}"
