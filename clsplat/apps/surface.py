"""The surface of a map: heights that the light supports, small holes filled, contour lines.

Where the ground is thin, half of the light passes it and ends at stray gaussians far below, so that
the median depth has a pit there. A pit differs from a true hole or a street between houses in where
the first tenth of the light is held back: above a pit, on the ground; in a true hole, at its
bottom.
"""

from __future__ import annotations

import math
import warnings

import contourpy
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter

from clsplat.errors import InputError

WINDOW, STEP = 13, 8  # samples of the local median along a side, and pixels between them
MARGIN = (WINDOW // 2 + 1) * STEP  # pixels around a tile that its windows need
LEAST_DEPTH = 10  # pixels: shallower pits are noise, which surfaces have everywhere
THICK = 0.5  # of a pit's depth: over less of it, and of LEAST_DEPTH, a true bottom's light spreads
LEAST_SURE = 0.1  # of the samples of a window: with fewer, no unsure height is kept
LINES, MOST_LINES = 15, 1000  # contour lines, about, unless the interval is given; and at most
USUAL = (0.02, 0.98)  # quantiles of the heights
SMOOTHING = 4.0  # pixels: noise of single pixels is no contour line
SHORTEST = 48  # points of a line; shorter ones are noise

Heights = NDArray[np.floating]  # [H, W], nan: unknown
Mask = NDArray[np.bool_]
ContourLine = tuple[float, NDArray[np.float64]]  # its height, and (column, row) [N, 2] along it


def pits(heights: Heights, spread: Heights, resolution: float) -> Mask:
    """Which pixels of a tile are pits, or unsure where hardly any height around is sure,
    bool[H, W].

    Parameters
    ----------
    heights : [H + 2 MARGIN, W + 2 MARGIN], map units; nan: unknown.
    spread : as heights: how far above them the first tenth of the light is held back.
    resolution : map units a pixel.
    """
    least = LEAST_DEPTH * resolution
    sure = np.where(spread <= least, heights, np.nan)[STEP // 2::STEP, STEP // 2::STEP]
    windows = np.lib.stride_tricks.sliding_window_view(sure, (WINDOW, WINDOW))[1:-1, 1:-1]
    with warnings.catch_warnings():  # of windows in which nothing is sure
        warnings.simplefilter("ignore", RuntimeWarning)
        level = np.nanmedian(windows, axis=(-2, -1))
    level[np.isfinite(windows).mean(axis=(-2, -1)) < LEAST_SURE] = np.inf
    inner = np.s_[MARGIN:heights.shape[0] - MARGIN, MARGIN:heights.shape[1] - MARGIN]
    depth = np.kron(level, np.ones((STEP, STEP))) - heights[inner]
    found: Mask = (depth > least) & (spread[inner] > np.minimum(THICK * depth, least))
    return found


def filled(values: NDArray[np.floating], known: Mask, most: int
           ) -> tuple[NDArray[np.floating], Mask]:
    """Values [H, W, bands] whose holes of at most so many pixels across have smooth values from
    around them, and which pixels are known now."""
    reach = most // 2
    grown = distance_transform_edt(~np.pad(known, reach + 1)) <= most / 2
    after = known | (distance_transform_edt(grown)[reach + 1:-reach - 1, reach + 1:-reach - 1]
                     > most / 2)
    if not (known.any() and (after & ~known).any()):
        return values, known
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    smooth = gaussian_filter(values[tuple(nearest)], (max(1.0, most / 4),) * 2 + (0,),
                             mode="nearest")
    return np.where((after & ~known)[..., None], smooth, values), after


def _smoothed(heights: Heights) -> NDArray[np.float64]:
    """Heights [H, W] after a Gaussian filter that leaves out those that are nan."""
    known = ~np.isnan(heights)
    weight = gaussian_filter(known.astype(np.float64), SMOOTHING)
    total = gaussian_filter(np.where(known, heights, 0.0), SMOOTHING)
    result: NDArray[np.float64] = np.where(known, total / np.maximum(weight, 1e-9), np.nan)
    return result


def contour_interval(heights: Heights) -> float:
    """A round number (1, 2 or 5 times a power of ten) that gives about LINES contour lines, in the
    unit of the heights; 0 for a surface without heights."""
    known = heights[~np.isnan(heights)]
    low, high = np.quantile(known, USUAL) if len(known) else (0.0, 0.0)
    if not high > low:
        return 0.0
    wanted = (high - low) / LINES
    power = 10 ** math.floor(math.log10(wanted))
    nearest = min((1, 2, 5, 10), key=lambda factor: abs(math.log(factor * power / wanted)))
    return float(f"{nearest * power:.1g}")


def contour_lines(heights: Heights, interval: float) -> list[ContourLine]:
    """Contour lines of a surface; the centre of the first pixel is (0.5, 0.5).

    Parameters
    ----------
    heights : [H, W]; nan: unknown, where lines end.
    interval : between lines; heights that are multiples of it have one. 0: there are no lines. An
        InputError if there would be too many.
    """
    known = ~np.isnan(heights)
    if interval <= 0 or not known.any() or min(heights.shape) < 2:
        return []
    low, high = np.quantile(heights[known], (0.001, 0.999))
    with np.errstate(over="ignore"):  # of an interval that is almost 0
        count = (high - low) / np.float64(interval)
    if count > MOST_LINES:
        raise InputError(f"--contours {interval:g}: about {count:.3g} lines; give a larger "
                         f"interval, at most {MOST_LINES:,} are drawn")
    generator = contourpy.contour_generator(
        z=np.ma.masked_array(_smoothed(heights), mask=~known))
    return [(number * interval, np.asarray(line) + 0.5)
            for number in range(math.ceil(low / interval), math.floor(high / interval) + 1)
            for line in generator.lines(number * interval) if len(line) >= SHORTEST]
