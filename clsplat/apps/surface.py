"""The surface of a map for the eye, in a preview with the orthophoto, and as points in a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.apps.contours import smoothed
from clsplat.apps.geotiff import Raster
from clsplat.io.models.points import Part, write_points
from clsplat.report.map_legend import map_legend

MOST_POINTS = 10_000_000  # of a LAZ file; a larger map gives a point to several pixels
FINENESS = 100  # coordinates are stored as multiples of about this part of a pixel
SUN = np.array([-1.0, 1.0, 1.4])  # east, north, up: from the north-west, as maps are shaded
# colours of the lowest, of the middle and of the highest ground
TINTS = np.array([[0.36, 0.55, 0.42], [0.87, 0.82, 0.62], [0.93, 0.91, 0.90]])
SIDE = 1400  # pixels, the longer side of each picture


def usual_heights(heights: NDArray[np.floating]) -> tuple[float, float]:
    """The heights between which a surface is coloured: where 2 and 98 % of it lie, smoothed."""
    low, high = np.nanquantile(smoothed(heights), (0.02, 0.98))
    return float(low), float(high)


def shaded(heights: NDArray[np.floating], resolution: float, interval: float = 0.0
           ) -> NDArray[np.float32]:
    """A picture of a surface, float32[H, W, 3], 0 to 1: coloured by height, lit by the sun, white
    where nothing is known.

    Parameters
    ----------
    heights : [H, W], map units; nan: unknown.
    resolution : map units a pixel.
    interval : between contour lines, map units; 0: none are drawn.
    """
    known = ~np.isnan(heights)
    if not known.any():
        return np.ones((*heights.shape, 3), np.float32)
    low, high = usual_heights(heights)
    filled = np.where(known, heights, low)
    share = np.clip((filled - low) / max(high - low, np.finfo(float).tiny), 0, 1)
    colours = np.stack([np.interp(share, (0, 0.5, 1), tint) for tint in TINTS.T], axis=-1)
    if min(heights.shape) > 1:
        down, across = np.gradient(filled, resolution)
        normal = np.stack([-across, down, np.ones_like(down)], axis=-1)
        light = normal @ (SUN / np.linalg.norm(SUN)) / np.linalg.norm(normal, axis=-1)
        colours *= (0.35 + 0.8 * np.clip(light, 0, 1))[..., None]
    if interval > 0:
        steps = np.floor(np.where(known, smoothed(heights), low) / interval)
        line = np.zeros(heights.shape, bool)
        line[1:] |= steps[1:] != steps[:-1]
        line[:, 1:] |= steps[:, 1:] != steps[:, :-1]
        colours[line] *= 0.45
    picture: NDArray[np.float32] = np.where(known[..., None], np.clip(colours, 0, 1), 1
                                            ).astype(np.float32)
    return picture


def write_surface(path: Path, surface: Raster, colours: Raster, level: int, crs: str | None
                  ) -> None:
    """Replace a LAS or LAZ file by a point for every known pixel of a surface.

    Parameters
    ----------
    path : the file; its suffix .laz compresses it.
    surface, colours : rasters of the same size: heights first, and red, green, blue and alpha.
    level : of the rasters that is taken.
    crs : coordinate reference system (CRS) as pyproj knows it; None: none is written.

    Raises
    ------
    clsplat.ClsplatError : laspy is not installed.
    """
    ends = [(np.nanmin(part[..., 0]), np.nanmax(part[..., 0]))
            for _, _, part in surface.parts(level) if np.isfinite(part[..., 0]).any()]
    lowest, highest = (min(low for low, _ in ends), max(high for _, high in ends)
                       ) if ends else (0.0, 0.0)
    left, bottom, right, top = surface.grid.bounds
    size = surface.grid.resolution * 2**level
    parts = (_points(part[..., 0], colour, left + column * size, top - row * size, size)
             for (column, row, part), (_, _, colour)
             in zip(surface.parts(level), colours.parts(level)))
    write_points(path, parts, ((left, bottom, lowest), (right, top, highest)), size / FINENESS, crs)


def _points(heights: NDArray[np.floating], colours: NDArray[np.uint8], left: float, top: float,
            size: float) -> Part:
    """The points of a part of a surface, whose pixels have a size."""
    rows, columns = np.nonzero(np.isfinite(heights))
    points = np.column_stack([left + (columns + 0.5) * size, top - (rows + 0.5) * size,
                              heights[rows, columns]])
    return points, colours[rows, columns, :3] / 255, np.zeros(len(points))


def preview(colours: Raster, surface: Raster, interval: float, crs: str | None
            ) -> NDArray[np.float32]:
    """A picture float32[H, W, 3], 0 to 1: orthophoto and shaded surface with contour lines on
    white, with a scale of lengths and one of heights below.

    Parameters
    ----------
    colours, surface : rasters of the map.
    interval : between contour lines, map units; 0: none.
    crs : of the map; None: lengths are scene units.
    """
    level = surface.level(SIDE)
    pixels = colours.whole(level).astype(np.float32) / 255
    left = pixels[..., :3] * pixels[..., 3:] + 1 - pixels[..., 3:]
    heights = surface.whole(level)[..., 0]
    size = surface.grid.resolution * 2**level
    gap = np.ones((len(left), max(4, left.shape[1] // 50), 3), np.float32)
    pictures = np.concatenate([left, gap, shaded(heights, size, interval)], axis=1)
    legend = map_legend(pictures.shape[1], left.shape[1], size, usual_heights(heights), TINTS,
                        interval, *(("m", "north is up") if crs else ("scene units", "")))
    picture: NDArray[np.float32] = np.concatenate([pictures, legend], axis=0)
    return picture
