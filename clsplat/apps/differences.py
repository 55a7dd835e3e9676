"""Differences of two surfaces of one place, and how large they must be to be no noise."""

import math
from dataclasses import replace

import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.apps.geotiff import Surface
from clsplat.apps.map_grid import MapGrid
from clsplat.errors import InputError

NORMAL = 1.4826  # by which the median absolute deviation of normal noise is its standard deviation
DETECTION = 1.96  # standard deviations: 95 % of noise is smaller
LEAST_PLACES = 9  # of which a noise is the median

Heights = NDArray[np.float64]


def nmad(values: Heights) -> float:
    """The normalised median absolute deviation (NMAD): a standard deviation that outliers, such as
    true changes, hardly touch; nan is left out."""
    return NORMAL * float(np.nanmedian(np.abs(values - np.nanmedian(values))))


def check_same_system(first: Surface, second: Surface) -> None:
    """InputError if two surfaces do not have the same coordinates."""
    if first.crs != second.crs:
        names = [(each.crs or "no georeference")[:40] for each in (first, second)]
        raise InputError(
            f"{second.path}: is in {names[1]}, and {first.path} in {names[0]}; convert one with gdalwarp -t_srs"
        )


def middles(grid: MapGrid) -> tuple[Heights, Heights]:
    """x and y of the centres of a grid's pixels, [rows, columns] each, map coordinates."""
    x = grid.left + (np.arange(grid.columns) + 0.5) * grid.resolution
    y = grid.top - (np.arange(grid.rows) + 0.5) * grid.resolution
    across, down = np.meshgrid(x, y)
    return across, down


def heights_at(surface: Surface, x: Heights, y: Heights) -> Heights:
    """The heights of a surface at places, between its pixels linearly; nan beside unknown ones."""
    size = surface.grid.resolution
    places = (surface.grid.top - y) / size - 0.5, (x - surface.grid.left) / size - 0.5
    result: Heights = scipy.ndimage.map_coordinates(surface.heights, places, order=1, cval=np.nan)
    return result


def difference_of(late: Surface, early: Surface) -> Surface:
    """A surface minus an earlier one, in the pixels of the first."""
    check_same_system(late, early)
    return replace(late, heights=late.heights - heights_at(early, *middles(late.grid)))


def noise_of(difference: Heights, pixel: float, area: float) -> float | None:
    """The standard deviation of a volume between two surfaces over an area where nothing changed:
    that of the volumes over squares of this area; None if fewer than LEAST_PLACES are known.

    It counts what neighbouring pixels have in common, such as a slow wave of one of the surfaces.

    Parameters
    ----------
    difference : [H, W]; nan: unknown, or changed.
    pixel : the side of its pixels.
    """
    side = max(1, round(math.sqrt(area) / pixel))
    rows, columns = (size // side for size in difference.shape)
    squares = difference[: rows * side, : columns * side].reshape(rows, side, columns, side)
    known = np.isfinite(squares).sum(axis=(1, 3))
    means = np.nansum(squares, axis=(1, 3))[known > side**2 / 2] / known[known > side**2 / 2]
    return NORMAL * float(np.median(np.abs(means))) * area if len(means) >= LEAST_PLACES else None
