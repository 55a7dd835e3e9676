"""The tiles a splat truly touches, by looking at every pixel."""

import numpy as np


def tiles_of(mean, conic, extent, cutoff, tiles_x, tiles_y, tile=16):
    """Set of (tile x, tile y) that hold a pixel centre with q <= cutoff.

    The grid has whole tiles: the last ones may reach past the image. Only pixels in mean +- extent
    (and one around it) are looked at; outside, q > cutoff by the definition of the extent.
    """
    first = np.floor(np.asarray(mean) - extent).astype(int) - 1
    last = np.ceil(np.asarray(mean) + extent).astype(int) + 1
    columns = np.arange(max(first[0], 0), min(last[0], tiles_x * tile))
    lines = np.arange(max(first[1], 0), min(last[1], tiles_y * tile))
    dx, dy = columns[None, :] + 0.5 - mean[0], lines[:, None] + 0.5 - mean[1]
    a, b, c = conic
    i, j = np.nonzero(a * dx**2 + 2 * b * dx * dy + c * dy**2 <= cutoff)
    return set(zip((columns[j] // tile).tolist(), (lines[i] // tile).tolist()))
