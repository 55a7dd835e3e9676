"""The map of a run: orthophoto and surface as GeoTIFF, contour lines, points and pictures."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.evaluation.run import Run
from clsplat.export.contours import (
    ContourLine,
    contour_interval,
    contour_lines,
    write_contours,
)
from clsplat.export.geotiff import TileStore, overviews, write_geotiff
from clsplat.export.map_grid import MapGrid, ground_resolution
from clsplat.export.orthophoto import MapPainter
from clsplat.export.reprojection import Reprojection, epsg_code
from clsplat.export.surface import MOST_POINTS, shaded, write_surface
from clsplat.io.folders import make_folder
from clsplat.io.georeference.crs import WGS84
from clsplat.io.images import write_image
from clsplat.io.records import write_object
from clsplat.rendering.project import LOW_PASS
from clsplat.rendering.slabs import open_model
from clsplat.scene import Scene

ORTHOPHOTO, SURFACE, POINTS = "orthophoto.tif", "surface.tif", "surface.laz"
CONTOURS, PREVIEW, RECORD = "contours.geojson", "preview.png", "map.json"
FILES = ORTHOPHOTO, SURFACE, POINTS, CONTOURS, PREVIEW, RECORD
PREVIEW_SIDE, CONTOUR_SIDE = 1400, 3000  # pixels of the coarser rasters that these are made from
HEIGHTS = (0.01, 0.99)  # quantiles that the record has: single pixels may be far off
DEGREE_DIGITS = 8  # after the point: a millimetre

Count = Callable[[str, int, int], object]  # (what, done, total)
Phase = Callable[[str], object]


@dataclass(frozen=True)
class Raster:
    """The rasters of a map with their overviews, from fine to coarse."""

    colours: list[TileStore]
    heights: list[TileStore]

    def level(self, largest: float, pixels: bool = False) -> int:
        """The finest level of at most so many pixels, in all or along the longer side."""
        sizes = [store.columns * store.rows if pixels else max(store.columns, store.rows)
                 for store in self.heights]
        return next((number for number, size in enumerate(sizes) if size <= largest),
                    len(sizes) - 1)


def write_map(run: Run, scene: Scene, grid: MapGrid, crs: str | None, device: Device,
              folder: Path, *, interval: float | None = None, points: bool = True,
              count: Count = lambda *_: None, phase: Phase = lambda _: None
              ) -> dict[str, Any]:
    """Write the map of a run into a folder; the files of an earlier map are replaced or removed.

    Parameters
    ----------
    run : finished.
    scene : of the run.
    grid : of the map.
    crs : coordinate reference system (CRS) of the map; None: the scene has no georeference.
    device : an open device.
    folder : created if it is missing.
    interval : between contour lines, map units; None: a round number that suits; 0: none.
    points : whether to write POINTS.
    count : called with what is done, how much of it, and how much there is.
    phase : called with what begins.

    Returns
    -------
    What RECORD holds.

    Raises
    ------
    clsplat.ClsplatError : an optional package is missing, the model shows nothing there, there
        would be too many contour lines, or the disk is full.
    """
    to_wgs84 = None if crs is None else Reprojection(crs, WGS84)
    if to_wgs84 and (points or interval != 0):
        to_wgs84.to_map(np.empty((0, 3)))  # that pyproj is missing is told before the work
    epsg = None if crs is None else epsg_code(crs)
    make_folder(folder)
    with ExitStack() as stack:
        ground = ground_resolution(scene)
        # gaussians smaller than a pixel would be drawn as large as one, and hide what is beside
        # them: a map coarser than the photos is the mean of finer pixels
        halvings = max(0, round(math.log2(grid.resolution / ground)))
        base = _drawn(run, scene, grid.finer(halvings), ground, device, folder, stack, count)
        phase("making overviews")
        raster = Raster(*(overviews(store, stack, halvings) for store in base))
        heights = raster.heights[raster.level(CONTOUR_SIDE)].whole()
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
        write_geotiff(folder / ORTHOPHOTO, raster.colours, grid, crs, epsg)
        write_geotiff(folder / SURFACE, raster.heights, grid, crs, epsg)
        write_image(folder / PREVIEW, _preview(raster, grid, interval))
        if interval:
            _write_contours(folder / CONTOURS, lines, raster, grid, to_wgs84)
            files.append(CONTOURS)
        if points:
            phase("writing points")
            level = raster.level(MOST_POINTS, pixels=True)
            write_surface(folder / POINTS, raster.heights[level], raster.colours[level], grid,
                          2**level, crs)
            files.append(POINTS)
    known = heights[np.isfinite(heights)]
    record = {
        "crs": crs, "unit": "metre" if crs else "scene unit", "resolution": grid.resolution,
        "columns": grid.columns, "rows": grid.rows, "bounds": grid.bounds,
        "heights": np.quantile(known, HEIGHTS).tolist(),
        "covered": float(len(known) / heights.size), "contour_interval": interval,
        "axes": grid.axes.tolist(), "origin": grid.origin.tolist(), "files": files}
    for name in set(FILES) - {*files, RECORD}:
        (folder / name).unlink(missing_ok=True)
    write_object(folder / RECORD, record, indent=2)
    return record


def _drawn(run: Run, scene: Scene, grid: MapGrid, ground: float, device: Device, folder: Path,
           stack: ExitStack, count: Count) -> tuple[TileStore, TileStore]:
    """Draw all tiles: colours and heights; `stack` will close their files."""
    model, options = run.finished_model, run.options
    # splats were trained with a low-pass of so many pixels of the photos: they keep their size
    finer = max(1.0, ground / grid.resolution)
    renderer, rows = open_model(
        device, model, 0.0, options.antialiased, options.background, orthographic=True,
        depth_percent=50, low_pass=LOW_PASS * finer**2)
    painter = MapPainter(renderer, rows, model.sh_degree, model.offset, grid, scene)
    size = grid.columns, grid.rows
    colours = stack.enter_context(TileStore(folder, *size, 4, np.uint8))
    heights = stack.enter_context(TileStore(folder, *size, 1, np.float32))
    across, down = grid.tiles
    for index in range(across * down):
        tile = painter.tile(index % across, index // across)
        colours.append(tile.colours)
        heights.append(tile.heights)
        count("tile", index + 1, across * down)
    return colours, heights


def _write_contours(path: Path, lines: list[ContourLine], raster: Raster, grid: MapGrid,
                    to_wgs84: Reprojection | None) -> None:
    size = grid.resolution * 2 ** raster.level(CONTOUR_SIDE)

    def to_place(line: NDArray[np.float64]) -> NDArray[np.float64]:
        places = np.column_stack([np.array([grid.left, grid.top]) + line * (size, -size),
                                  np.zeros(len(line))])
        return (places if to_wgs84 is None else to_wgs84.to_map(places))[:, :2]

    digits = DEGREE_DIGITS if to_wgs84 else max(0, math.ceil(1 - math.log10(size)))
    write_contours(path, lines, to_place, digits)


def _preview(raster: Raster, grid: MapGrid, interval: float) -> NDArray[np.float32]:
    """Orthophoto and shaded surface with contour lines, one beside the other, on white."""
    level = raster.level(PREVIEW_SIDE)
    pixels = raster.colours[level].whole().astype(np.float32) / 255
    colours = pixels[..., :3] * pixels[..., 3:] + 1 - pixels[..., 3:]
    surface = shaded(raster.heights[level].whole(), grid.resolution * 2**level, interval)
    gap = np.ones((len(colours), max(4, colours.shape[1] // 50), 3), np.float32)
    picture: NDArray[np.float32] = np.concatenate([colours, gap, surface], axis=1)
    return picture
