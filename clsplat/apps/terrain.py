"""The terrain of a map: its surface without buildings, trees and cars.

The ground is found by the simple morphological filter (SMRF) of Pingel, Clarke & McBride 2013 ("An
improved simple morphological filter for the terrain classification of airborne LIDAR data"), with
squares in place of discs. Their constants are for objects 36 m wide in cells of 1 m; here all
lengths follow from the width of the widest object.
"""

import math

import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.apps.geotiff import Raster
from clsplat.apps.map_grid import TILE
from clsplat.errors import InputError

CELLS = 36  # along the widest object
SLOPE = 0.15  # rise over run of the ground; what is steeper over a window is an object
ABOVE = 0.5  # cells above or below the terrain, within which the surface is ground
ABOVE_SLOPE = 1.25  # cells more for each unit of slope of the terrain
PIT, PIT_WIDTH = 5.0, 3  # cells: what is deeper and narrower is a wrong height
MOST_CELLS = 4096  # along a side
LEAST_PIXELS = 4  # along the widest object

Heights = NDArray[np.float64]  # [H, W], nan: unknown


def check_width(width: float, resolution: float) -> None:
    """InputError if the widest object is too narrow for pixels of this size."""
    if width < LEAST_PIXELS * resolution:
        raise InputError(f"--terrain {width:g}: narrower than {LEAST_PIXELS} pixels of "
                         f"{resolution:g}; give the width of the widest building")


def write_terrain(surface: Raster, terrain: Raster, width: float) -> float:
    """Write the terrain of a surface.

    Parameters
    ----------
    surface : finished; its first band is heights.
    terrain : of the same grid; gets two bands: the height of the terrain, and 1 where that is the
        surface, 0 where it is interpolated beneath an object.
    width : of the widest object that is no ground, map units.

    Returns
    -------
    The share of the surface that is ground.
    """
    grid = surface.grid
    level = round(math.log2(width / CELLS / grid.resolution))
    level = max(surface.level(MOST_CELLS), min(level, surface.level(TILE)), 0)
    heights, tolerance = terrain_of(surface.whole(level)[..., 0].astype(np.float64),
                                    grid.resolution * 2**level, width)
    known, ground = 0, 0
    for y, x in np.ndindex(grid.tiles[::-1]):
        shown = surface.read((x, y))[..., 0]
        if np.isnan(shown).all():
            continue
        places = np.meshgrid(*((TILE * tile + np.arange(TILE) + 0.5) / 2**level - 0.5
                               for tile in (y, x)), indexing="ij")
        beneath, limit = (scipy.ndimage.map_coordinates(values, places, order=1, mode="nearest")
                          for values in (heights, tolerance))
        with np.errstate(invalid="ignore"):
            same = np.abs(shown - beneath) <= limit
        both = np.stack([np.where(same, shown, beneath), same], axis=-1)
        terrain.write((x, y), np.where(np.isnan(shown)[..., None], np.nan, both))
        known, ground = known + int(np.isfinite(shown).sum()), ground + int(same.sum())
    return ground / max(known, 1)


def terrain_of(heights: Heights, cell: float, width: float) -> tuple[Heights, Heights]:
    """The heights of the ground everywhere, and how far from them a surface is still ground.

    Parameters
    ----------
    heights : of the surface; at least one is known.
    cell : the side of a pixel.
    width : of the widest object, in the same unit.
    """
    known = np.isfinite(heights)
    surface = filled(heights, known)
    known &= scipy.ndimage.grey_closing(surface, PIT_WIDTH) - surface <= PIT * cell
    opened = surface = filled(heights, known)
    is_object = np.zeros(known.shape, bool)
    for radius in range(1, max(1, math.ceil(width / cell / 2)) + 1):
        before, opened = opened, scipy.ndimage.grey_opening(opened, 2 * radius + 1)
        is_object |= before - opened > SLOPE * radius * cell
    lower = known & ~is_object
    if not lower.any():
        lower = known
    provisional = filled(surface, lower)
    ground = known & (np.abs(surface - provisional) <= _tolerance(provisional, cell, width))
    terrain = filled(surface, ground if ground.any() else lower)
    return terrain, _tolerance(terrain, cell, width)


def _tolerance(terrain: Heights, cell: float, width: float) -> Heights:
    """How far from a terrain the ground may be, by its slope."""
    slope: Heights = np.hypot(*np.gradient(np.pad(terrain, ((0, 1), (0, 1)), "edge"), cell))
    return (ABOVE + ABOVE_SLOPE * slope[:-1, :-1]) * width / CELLS


def filled(heights: Heights, known: NDArray[np.bool_]) -> Heights:
    """Heights with their gaps filled: linearly between the known ones around, and beyond the
    outermost with the nearest."""
    if known.all():
        return heights
    nearest = scipy.ndimage.distance_transform_edt(~known, return_distances=False,
                                                   return_indices=True)
    result: Heights = heights[tuple(nearest)]
    border = known & scipy.ndimage.binary_dilation(~known)
    try:
        between = scipy.interpolate.LinearNDInterpolator(np.argwhere(border), heights[border])
    except scipy.spatial.QhullError:  # fewer than three cells, or all in one line
        return result
    inside = between(np.argwhere(~known))
    result[~known] = np.where(np.isfinite(inside), inside, result[~known])
    return result
