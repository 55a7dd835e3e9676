"""The surface of a map for the eye, and as points in a LAS or LAZ file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.export.contours import smoothed
from clsplat.export.geotiff import TileStore
from clsplat.export.map_grid import TILE, MapGrid
from clsplat.io.las import Part, write_points

MOST_POINTS = 10_000_000  # of a LAZ file; a larger map gives a point to several pixels
FINENESS = 100  # coordinates are stored as multiples of about this part of a pixel
SUN = np.array([-1.0, 1.0, 1.4])  # east, north, up: from the north-west, as maps are shaded
# colours of the lowest, of the middle and of the highest ground
TINTS = np.array([[0.36, 0.55, 0.42], [0.87, 0.82, 0.62], [0.93, 0.91, 0.90]])


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
    low, high = np.quantile(heights[known], (0.01, 0.99))
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


def write_surface(path: Path, surface: TileStore, colours: TileStore, grid: MapGrid, step: int,
                  crs: str | None) -> None:
    """Replace a LAS or LAZ file by a point for every known pixel of a surface.

    Parameters
    ----------
    path : the file; its suffix .laz compresses it.
    surface, colours : rasters of the same size: heights, and red, green, blue and alpha.
    grid : of the map.
    step : pixels of the map for each pixel of the rasters.
    crs : coordinate reference system (CRS) as pyproj knows it; None: none is written.

    Raises
    ------
    clsplat.ClsplatError : laspy is not installed.
    """
    across, down = surface.tiles
    places = [(x, y) for y in range(down) for x in range(across)]
    heights = np.array([(np.nanmin(tile), np.nanmax(tile)) for tile in (
        surface.read(*place) for place in places) if not np.isnan(tile).all()])
    lowest, highest = (heights[:, 0].min(), heights[:, 1].max()) if len(heights) else (0.0, 0.0)
    left, bottom, right, top = grid.bounds
    write_points(path, (_part(surface, colours, grid, step, place) for place in places),
                 ((left, bottom, lowest), (right, top, highest)),
                 grid.resolution * step / FINENESS, crs)


def _part(surface: TileStore, colours: TileStore, grid: MapGrid, step: int,
          place: tuple[int, int]) -> Part:
    """The points of a tile."""
    heights, pixels = surface.read(*place), colours.read(*place)
    rows, columns = np.nonzero(~np.isnan(heights))
    inside = (place[1] * TILE + rows < surface.rows) & (place[0] * TILE + columns < surface.columns)
    rows, columns = rows[inside], columns[inside]
    size = grid.resolution * step
    points = np.column_stack([grid.left + (place[0] * TILE + columns + 0.5) * size,
                              grid.top - (place[1] * TILE + rows + 0.5) * size,
                              heights[rows, columns]])
    return points, pixels[rows, columns, :3] / 255, np.zeros(len(points))
