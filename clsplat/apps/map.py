"""The map of a run: orthophoto and surface as GeoTIFF, contour lines and a picture, and a
statement of how exact it is."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from shutil import rmtree
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.apps.geotiff import Raster, bounded_memory
from clsplat.apps.map_grid import TILE, MapGrid, ground_resolution
from clsplat.apps.orthophoto import Extent, MapPainter, extent_of, halved_pixels
from clsplat.apps.surface import (
    MARGIN,
    ContourLine,
    contour_interval,
    contour_lines,
    filled,
    pits,
)
from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.evaluation.run import Run
from clsplat.georeference import AXES, CHECK, CONTROL
from clsplat.io.atomic import replacing
from clsplat.io.folders import make_folder
from clsplat.io.georeference.crs import WGS84, heights_of, on_ground
from clsplat.io.records import write_object
from clsplat.report.figures.map_preview import write_preview
from clsplat.scene import Scene

ORTHOPHOTO, SURFACE = "orthophoto.tif", "surface.tif"
CONTOURS, PREVIEW, RECORD = "contours.geojson", "preview.png", "map.json"
FILES = ORTHOPHOTO, SURFACE, CONTOURS, PREVIEW, RECORD
CONTOUR_SIDE = 3000  # pixels of the coarser raster that they are made from
PREVIEW_SIDE = 1400  # pixels, the longer side of each of its pictures
HEIGHTS = (0.01, 0.99)  # quantiles that the record has: single pixels may be far off
DEGREE_DIGITS = 8  # after the point: a millimetre
DIGITS = 9  # of heights
COLOURS = dict.fromkeys(("red", "green", "blue", "alpha"))  # bands, without a unit
HEIGHTS_OF = "height", "spread"
SCRATCH = ".drawing-"  # how the name of the temporary folder begins
MOST_HALVINGS = 9  # a tile is then one pixel

Count = Callable[[str, int, int], object]  # (what, done, total)
Phase = Callable[[str], object]


def write_map(run: Run, scene: Scene, grid: MapGrid, device: Device, folder: Path, *,
              interval: float | None = None, fill: int = 0, follow: bool = False,
              count: Count = lambda *_: None, phase: Phase = lambda _: None) -> dict[str, Any]:
    """Write the map of a run into a folder; the files of an earlier map are replaced or removed.

    Parameters
    ----------
    run, scene : finished, and its scene, whose georeference the map has.
    grid : of the map.
    device : an open device.
    folder : created if it is missing.
    interval : between contour lines, map units; None: a round number that suits; 0: none.
    fill : holes of at most so many pixels across are filled, at most MARGIN.
    follow : whether the bounds become those of all that the map can show.
    count, phase : called with what is done, how much of it, and how much there is; and with what
        begins.

    Returns
    -------
    What RECORD holds.
    """
    crs = scene.georeference.crs if scene.georeference else None
    make_folder(folder)
    for killed in folder.glob(SCRATCH + "*"):
        rmtree(killed, ignore_errors=True)
    with bounded_memory(), TemporaryDirectory(dir=folder, prefix=SCRATCH) as scratch:
        phase("looking at the extent")
        extent = extent_of(device, run, scene, grid)
        if follow:
            grid = extent.around(grid)
        unit = "metre" if crs else "scene unit"
        statement = stated(scene)
        drawn, result = (
            (Raster(Path(scratch) / f"{stage}-colours", grid, crs, COLOURS, True),
             Raster(Path(scratch) / f"{stage}-surface", grid, crs, dict.fromkeys(HEIGHTS_OF, unit),
                    False)) for stage in ("drawn", "cleaned"))
        colours, surface = result
        _draw(run, scene, grid, extent, device, drawn, count)
        phase("leaving out pits")
        dropped, new = _cleaned(drawn, result, fill)
        phase("making overviews")
        for raster in result:
            raster.finish(tags_of(statement))
        level = surface.level(CONTOUR_SIDE)
        heights = surface.whole(level)[..., 0]
        if not np.isfinite(heights).any():
            raise InputError(f"{run.path}: everywhere on the map, the model is transparent or "
                             "fewer than two photos show the place; train longer, or give other "
                             "--bounds")
        if interval is None:
            interval = contour_interval(heights)
        if interval:
            phase("drawing contour lines")
        lines = contour_lines(heights, interval)  # first of all: there may be too many of them
        files = [ORTHOPHOTO, SURFACE, PREVIEW]
        phase("writing GeoTIFF files")
        colours.save(folder / ORTHOPHOTO)
        surface.save(folder / SURFACE)
        _write_preview(folder / PREVIEW, colours, surface, lines, level, interval, unit)
        if interval:
            _write_contours(folder / CONTOURS, lines, grid, level, crs)
            files.append(CONTOURS)
    known = heights[np.isfinite(heights)]
    record = {
        "crs": crs, "unit": unit, "resolution": grid.resolution,
        "columns": grid.columns, "rows": grid.rows, "bounds": grid.bounds,
        "heights": np.quantile(known, HEIGHTS).tolist(),
        "covered": float(len(known) / heights.size), "contour_interval": interval,
        "pits": dropped, "filled": new, **statement,
        "bands": {ORTHOPHOTO: list(COLOURS), SURFACE: list(HEIGHTS_OF)},
        "axes": grid.axes.tolist(), "origin": grid.origin.tolist(), "files": files}
    for name in set(FILES) - {*files, RECORD}:
        (folder / name).unlink(missing_ok=True)
    write_object(folder / RECORD, record, indent=2)
    return record


def _draw(run: Run, scene: Scene, grid: MapGrid, extent: Extent, device: Device,
          drawn: tuple[Raster, Raster], count: Count) -> None:
    """Draw all tiles in which anything is known."""
    # gaussians smaller than a pixel would be drawn as large as one, and hide what is beside
    # them: a map coarser than the photos is the mean of finer pixels
    halvings = min(max(0, round(math.log2(grid.resolution / ground_resolution(scene)))),
                   MOST_HALVINGS)
    finer = grid.finer(halvings)
    painter = MapPainter(device, run, finer, scene)
    across, side = 2**halvings, TILE >> halvings
    done, total = 0, math.prod(finer.tiles)
    for row, column in np.ndindex(grid.tiles[::-1]):
        whole: tuple[NDArray[Any], NDArray[Any]] = (
            np.zeros((TILE, TILE, 4), np.uint8), np.full((TILE, TILE, 2), np.nan, np.float32))
        is_known = False
        for y, x in np.ndindex(across, across):
            place = column * across + x, row * across + y
            if place[0] >= finer.tiles[0] or place[1] >= finer.tiles[1]:
                continue
            done += 1
            inside = extent.inside(finer, *place)[..., None]
            if not inside.any():
                continue
            is_known = True
            count("tile", done, total)
            colours, surface = painter.tile(*place)
            for all_pixels, pixels in zip(whole, (np.where(inside, colours, 0), np.where(
                    inside, surface, np.float32(np.nan)))):
                for _ in range(halvings):
                    pixels = halved_pixels(pixels)
                all_pixels[y * side:(y + 1) * side, x * side:(x + 1) * side] = pixels
        if is_known:
            for raster, values in zip(drawn, whole):
                raster.write((column, row), values)
    for raster in drawn:
        raster.close()


def _cleaned(drawn: tuple[Raster, Raster], result: tuple[Raster, Raster], fill: int
             ) -> tuple[int, int]:
    """Copy colours, and heights without pits, with small holes filled; how many heights are left
    out, and how many are filled."""
    dropped = filled_count = 0
    own = np.s_[MARGIN:-MARGIN, MARGIN:-MARGIN]
    for y, x in np.ndindex(drawn[0].grid.tiles[::-1]):
        colours = drawn[0].read((x, y), MARGIN)
        alpha = colours[..., 3] > 0
        if not alpha.any():
            continue
        heights = drawn[1].read((x, y), 2 * MARGIN)
        found = pits(heights[..., 0], heights[..., 1], drawn[1].grid.resolution)
        heights = heights[own]
        known = np.isfinite(heights[..., 0]) & ~found
        dropped += int((alpha & ~known)[own].sum())
        if fill:
            smooth, alpha = filled(colours.astype(np.float32), alpha, fill)
            colours = np.round(smooth)
            colours[..., 3][(colours[..., 3] == 0) & alpha] = 255
            heights, more = filled(heights, known, fill)
            filled_count += int((more & ~known)[own].sum())
            known = more
        result[0].write((x, y), colours[own])
        result[1].write((x, y), np.where(known[..., None], heights, np.nan)[own])
    return dropped, filled_count


def _write_contours(path: Path, lines: list[ContourLine], grid: MapGrid, level: int,
                    crs: str | None) -> None:
    """Replace a GeoJSON file (RFC 7946); every line is a feature with the property `elevation`, in
    longitude and latitude, or the map's coordinates if the scene has no place on the earth."""
    size = grid.resolution * 2**level
    vertices = np.concatenate([np.empty((0, 2)), *(line for _, line in lines)])
    places = np.pad((grid.left, grid.top) + vertices * (size, -size), ((0, 0), (0, 1)))
    digits = DEGREE_DIGITS if crs else max(0, math.ceil(1 - math.log10(size)))
    places = np.round((on_ground(crs, WGS84, places) if crs else places)[:, :2], digits)
    ends = np.cumsum([len(line) for _, line in lines])
    features = [
        {"type": "Feature", "properties": {"elevation": round(height, DIGITS)},
         "geometry": {"type": "LineString", "coordinates": line.tolist()}}
        for (height, _), line in zip(lines, np.split(places, ends))]
    with replacing(path) as file:
        file.write(json.dumps({"type": "FeatureCollection", "features": features}).encode())


def _write_preview(path: Path, colours: Raster, surface: Raster, lines: list[ContourLine],
                   level_of_lines: int, interval: float, unit: str) -> None:
    level = surface.level(PREVIEW_SIDE)
    with replacing(path) as file:
        write_preview(file, colours.whole(level), surface.whole(level)[..., 0],
                      [line * 2.0**(level_of_lines - level) for _, line in lines],
                      surface.grid.resolution * 2**level, interval, unit)


def stated(scene: Scene) -> dict[str, Any]:
    """What is known of a map's exactness, for RECORD: the ground sampling distance of the photos,
    the vertical reference, and the georeference with its residuals, metres."""
    result: dict[str, Any] = {"ground_sampling_distance": ground_resolution(scene)}
    place = scene.georeference
    if place is None:
        return result
    errors = {role: {axis: error.rms for axis, error in place.errors(role).items()}
              for role in (CHECK, CONTROL)}
    return {**result,
            "vertical_reference": place.vertical or heights_of(place.crs).name or "unknown",
            "georeference": {"source": place.source, "residual": place.residual,
                             "residuals_rms": {role: axes for role, axes in errors.items() if axes},
                             "warnings": list(place.warnings)}}


def tags_of(statement: dict[str, Any]) -> dict[str, str]:
    """The tags of a GeoTIFF, in GDAL's metadata."""
    return {"TIFFTAG_SOFTWARE": "clsplat",
            **{name.upper(): value if isinstance(value, str) else json.dumps(value)
               for name, value in statement.items()}}


def sentences(statement: dict[str, Any], unit: str) -> list[str]:
    """What `clsplat map` prints of it."""
    lines = [f"ground sampling distance of the photos {statement['ground_sampling_distance']:g} "
             f"{unit}"]
    place = statement.get("georeference")
    if place:
        lines[0] += f"; heights: {statement['vertical_reference']}"
        lines.append(f"georeference: {place['source'] or 'unknown source'}, residual "
                     f"{place['residual']:.2f} m along the ground")
        for role, axes in place["residuals_rms"].items():
            lines.append(f"{role} RMS: " + ", ".join(
                f"{axis} {axes[axis]:.2f} m" for axis in AXES if axis in axes))
        lines += [f"warning: {text}" for text in place["warnings"]]
    return lines
