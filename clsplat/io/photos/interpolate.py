"""Images interpolated at any places, by sparse matrices of weights.

The kernel is the cubic convolution of Keys (1981) with a = -1/2, also called Catmull-Rom. A linear
kernel blurs: docs/evidence/photos.md has figures.
"""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

PATCH_SIDE = 192  # pixels: what is computed for a patch stays in the cache
TAPS = np.arange(-1, 3, dtype=np.int32)  # from the pixel at the left of a place, or above it


class Patch(NamedTuple):
    """Weights for a part of the interpolated image.

    Attributes
    ----------
    part : rows and columns of the result.
    shown : bool[n, m], which pixels of the part have a place.
    source : rows and columns of the image on which they depend, R of them.
    weights : float32[S, R], for the S pixels that are shown.
    """

    part: tuple[slice, slice]
    shown: NDArray[np.bool_]
    source: tuple[slice, slice]
    weights: csr_matrix


def patches(places: NDArray[np.float32], size: tuple[int, int], round_trip: bool = False
            ) -> Iterator[Patch]:
    """Yield the weights of the interpolated image, except for patches without a place.

    Pixels beyond the border are those of the border.

    Parameters
    ----------
    places : float32[2, H, W], x and y in pixels of the image, or nan.
    size : (width, height) of the image.
    round_trip : whether its left and right borders are neighbours.
    """
    width, height = size
    for top, left in itertools.product(*(range(0, side, PATCH_SIDE) for side in places.shape[1:])):
        part = slice(top, top + PATCH_SIDE), slice(left, left + PATCH_SIDE)
        shown = np.isfinite(places[0][part])
        if not shown.any():
            continue
        x, y = places[(slice(None), *part)][:, shown] - np.float32(0.5)
        column, row = np.floor(x).astype(np.int32), np.floor(y).astype(np.int32)
        columns, rows = column[:, None] + TAPS, np.clip(row[:, None] + TAPS, 0, height - 1)
        columns = columns % width if round_trip else np.clip(columns, 0, width - 1)
        low, high = (columns.min(), rows.min()), (columns.max() + 1, rows.max() + 1)
        indices = ((rows - low[1]) * (high[0] - low[0]))[:, :, None] + (columns - low[0])[:, None]
        weights = _kernel(y - row)[:, :, None] * _kernel(x - column)[:, None]
        begins = np.arange(0, indices.size + 1, len(TAPS) ** 2)
        yield Patch(part, shown, (slice(low[1], high[1]), slice(low[0], high[0])), csr_matrix(
            (weights.ravel(), indices.ravel(), begins),
            shape=(len(x), (high[1] - low[1]) * (high[0] - low[0]))))


def _kernel(f: NDArray[np.float32]) -> NDArray[np.float32]:
    """float32[N, 4]: the weights of the four pixels around places at shares f [N] of the way from
    the second to the third."""
    half = np.float32(0.5)
    weights: NDArray[np.float32] = half * np.stack([
        f * (f * (2 - f) - 1), f * f * (3 * f - 5) + 2, f * (f * (4 - 3 * f) + 1),
        f * f * (f - 1)], axis=1)
    return weights
