"""The report of a survey, as surveyors hand in: photos, accuracy, coverage and the maps."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat import __version__
from clsplat.apps.geotiff import Raster
from clsplat.apps.map_files import ORTHOPHOTO, SURFACE, TERRAIN
from clsplat.evaluation.survey import Photographs, Survey, vertical_reference
from clsplat.georeference import CHECK
from clsplat.io.atomic import replacing
from clsplat.report.figures.map_preview import TINTS, shaded
from clsplat.report.figures.survey import Sheet, write_pages
from clsplat.report.page import Table
from clsplat.report.survey import facts, residual_tables, warnings

HEIGHT_SHEETS = {
    SURFACE: ("Surface", "Heights with houses and trees, shaded with the sun in the north-west."),
    TERRAIN: ("Terrain", "Heights of the ground without houses and trees, shaded likewise."),
}
UNCHECKED = (
    "none, so that the error of the map is not known: residuals of places that decided where it lies do not show it"
)


def write_report(
    path: Path,
    name: str,
    survey: Survey,
    photos: Photographs,
    rasters: Mapping[str, Raster],
    level: int,
    record: dict[str, Any],
) -> None:
    """Replace a PDF by the report of a survey.

    Parameters
    ----------
    name : of the map.
    survey : of the scene at the size of its photos.
    photos : how they were taken.
    rasters : of the map, by the names of its files.
    level : of them, whose pixels are shown.
    record : of the map.
    """
    unit = "m" if record["crs"] else "scene units"
    try:
        said, known = warnings(survey), list(facts(survey))
    except (TypeError, ValueError) as error:  # of a damaged sfm.json, which costs no map
        said, known = (f"the facts of the survey cannot be shown ({error})",), []
    checked = any(each.role == CHECK for each in survey.residuals)
    tables = (
        Table("Warnings", ("",), [(text,) for text in said]),
        Table("Survey", ("", ""), [*_photo_facts(photos), *known]),
        Table("Map", ("", ""), list(_map_facts(record, unit))),
        Table("Accuracy", ("", ""), [] if checked or not record["crs"] else [("check points", UNCHECKED)]),
        *residual_tables(survey),
    )
    with replacing(path) as file:
        write_pages(file, f"Survey of {name}", f"clsplat {__version__}", tables, _sheets(survey, rasters, level, unit))


def _photo_facts(photos: Photographs) -> Iterator[tuple[str, str]]:
    for camera, count in photos.cameras.items():
        yield "camera", f"{camera}: {count:,} photos"
    if photos.period:
        zone = "UTC" if photos.period[0].tzinfo else "by the camera's clock"
        yield "taken", " to ".join(f"{each:%Y-%m-%d %H:%M}" for each in photos.period) + f", {zone}"


def _map_facts(record: dict[str, Any], unit: str) -> Iterator[tuple[str, str]]:
    left, bottom, right, top = record["bounds"]
    yield "coordinate system", (record["crs"] or "none")[:200]
    if not record["crs"]:  # else it is among the facts of the survey
        yield "heights", record["vertical_reference"]
    x, y = ("east", "north") if record["crs"] else ("x", "y")
    yield "extent", (f"{x} {left:,.2f} to {right:,.2f}, {y} {bottom:,.2f} to {top:,.2f} {unit}")
    yield (
        "pixels",
        (
            f"{record['columns']:,} x {record['rows']:,} of {record['resolution']:g} "
            f"{unit}, {record['covered']:.0%} with heights"
        ),
    )
    yield "98 % of the heights", "{:,.2f} to {:,.2f} ".format(*record["heights"]) + unit
    yield "unsure heights", f"{record['pits']:,} pixels, left out"
    if "terrain" in record:
        yield (
            "terrain",
            (
                f"{record['terrain']['ground']:.0%} of the surface is ground; objects up "
                f"to {record['terrain']['width']:g} {unit} wide are left out"
            ),
        )


def _sheets(survey: Survey, rasters: Mapping[str, Raster], level: int, unit: str) -> Iterator[Sheet]:
    """The pages with maps."""
    grid, north = rasters[ORTHOPHOTO].grid, survey.georeference is not None
    if survey.overlap is not None:
        offset = np.array(survey.georeference.offset[:2] if survey.georeference else (0.0, 0.0))
        west, east, south, top = survey.overlap.bounds
        counts = survey.overlap.counts[::-1]
        yield Sheet(
            "Coverage",
            "How many photos look at each place, and where they were taken (dots).",
            np.where(counts < 0, np.nan, counts),
            (*(offset + (west, south)), *(offset + (east, top))),
            unit,
            north,
            (0, int(counts.max()), "viridis", "photos that look at a place"),
            survey.cameras + offset,
        )
    picture = rasters[ORTHOPHOTO].whole(level)
    yield Sheet("Orthophoto", f"Pixels of {grid.resolution:g} {unit} in the file.", picture, grid.bounds, unit, north)
    for file, (title, note) in HEIGHT_SHEETS.items():
        if file in rasters:
            heights: NDArray[np.floating] = rasters[file].whole(level)[..., 0]
            pixels, low, high = shaded(heights, grid.resolution * 2**level)
            reference = vertical_reference(survey.georeference)
            yield Sheet(
                title,
                f"{note} Heights: {reference}.",
                (255 * pixels).astype(np.uint8),
                grid.bounds,
                unit,
                north,
                (low, high, TINTS, f"height, {unit}"),
            )
