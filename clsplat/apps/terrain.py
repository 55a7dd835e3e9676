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
PIT, PIT_WIDTH = 0.5, 5  # cells: what is deeper and narrower is a wrong height, not ground
SMOOTHING = 3.0  # cells, before a slope is taken
MOST_CELLS = 2048  # along a side
PRECISION, MOST_STEPS = 1e-4, 300  # of the membranes over gaps
LEAST_PIXELS = 4  # along the widest object

Heights = NDArray[np.float64]  # [H, W], nan: unknown


def check_width(width: float, resolution: float) -> None:
    """InputError if the widest object is too narrow for pixels of this size."""
    if width < LEAST_PIXELS * resolution:
        raise InputError(
            f"--terrain {width:g}: narrower than {LEAST_PIXELS} pixels of "
            f"{resolution:g}; give the width of the widest building"
        )


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
    heights, tolerance = terrain_of(surface.whole(level)[..., 0].astype(np.float64), grid.resolution * 2**level, width)
    known, ground = 0, 0
    for y, x in np.ndindex(grid.tiles[::-1]):
        shown = surface.read((x, y))[..., 0]
        if np.isnan(shown).all():
            continue
        places = np.meshgrid(
            *((TILE * tile + np.arange(TILE) + 0.5) / 2**level - 0.5 for tile in (y, x)), indexing="ij"
        )
        beneath, limit = (
            scipy.ndimage.map_coordinates(values, places, order=1, mode="nearest") for values in (heights, tolerance)
        )
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
    known, widest = np.isfinite(heights), max(1, math.ceil(width / cell / 2))
    surface = nearest(heights, known)
    closed = scipy.ndimage.grey_closing(surface, PIT_WIDTH)
    pits = closed - surface > PIT * width / CELLS
    # the lowest ground around, to which pits are lifted; and what is unknown is as low, as it must
    # not widen an object beside it
    around = scipy.ndimage.minimum_filter(np.where(known, closed, np.inf), 2 * widest + 1)
    opened = np.where(known, np.where(pits, np.maximum(surface, around), surface), nearest(around, np.isfinite(around)))
    known &= ~pits
    is_object = np.zeros(known.shape, bool)
    for radius in range(1, widest + 1):
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
    """How far from a terrain the ground may be, by its slope without noise."""
    smooth = scipy.ndimage.gaussian_filter(terrain, SMOOTHING, mode="nearest")
    slope: Heights = np.hypot(*np.gradient(np.pad(smooth, ((0, 1), (0, 1)), "edge"), cell))
    return (ABOVE + ABOVE_SLOPE * slope[:-1, :-1]) * width / CELLS


def nearest(heights: Heights, known: NDArray[np.bool_]) -> Heights:
    """Heights of which those that are not known are the nearest known one."""
    places = scipy.ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    result: Heights = heights[tuple(places)]
    return result


def filled(heights: Heights, known: NDArray[np.bool_]) -> Heights:
    """Heights with their gaps filled by a membrane: each is the mean of its four neighbours."""
    gap = ~known.ravel()
    if not gap.any():
        return heights
    steps = [
        scipy.sparse.diags_array([-np.ones(size), np.ones(size)], offsets=[0, 1], shape=(max(size - 1, 0), size))
        for size in heights.shape
    ]
    rows = scipy.sparse.kronsum(*(step.T @ step for step in reversed(steps)), "csr")[gap]
    result = nearest(heights, known)
    flat = result.ravel()
    flat[gap], _ = scipy.sparse.linalg.cg(
        rows[:, gap], -rows[:, ~gap] @ flat[~gap], flat[gap], rtol=PRECISION, maxiter=MOST_STEPS
    )
    return result
