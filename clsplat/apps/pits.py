"""Heights that the light does not support, and small holes that are filled.

Where the ground is thin, half of the light passes it and ends at stray gaussians far below, so that
the median depth has a pit there. A pit differs from a true hole or a street between houses in where
the first tenth of the light is held back: above a pit, on the ground; in a true hole, at its
bottom.
"""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter

WINDOW, STEP = 13, 8  # samples of the local median along a side, and pixels between them
MARGIN = (WINDOW // 2 + 1) * STEP  # pixels around a tile that its windows need
LEAST_DEPTH = 10  # pixels: shallower pits are noise, which surfaces have everywhere
THICK = 0.5  # of a pit's depth: over less of it, and of LEAST_DEPTH, a true bottom's light spreads
LEAST_SURE = 0.1  # of the samples of a window: with fewer, no unsure height is kept

Heights = NDArray[np.floating]
Mask = NDArray[np.bool_]


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
    deep = np.minimum(THICK * depth, least)
    found: Mask = (depth > least) & (spread[inner] > deep)
    return found


def closed(known: Mask, most: int) -> Mask:
    """What is known together with gaps of at most so many pixels across, bool[H, W]."""
    reach = most // 2
    padded = np.pad(known, reach + 1)
    grown = distance_transform_edt(~padded) <= most / 2
    found: Mask = distance_transform_edt(grown)[reach + 1:-reach - 1, reach + 1:-reach - 1
                                                ] > most / 2
    return found | known


def filled(values: NDArray[np.floating], known: Mask, most: int
           ) -> tuple[NDArray[np.floating], Mask]:
    """Values [H, W, bands] whose holes of at most so many pixels across have smooth values from
    around them, and which pixels are known now."""
    after = closed(known, most)
    if not (known.any() and (after & ~known).any()):
        return values, known
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    whole = values[tuple(nearest)]
    smooth = gaussian_filter(whole, (max(1.0, most / 4),) * 2 + (0,), mode="nearest")
    return np.where((after & ~known)[..., None], smooth, values), after
