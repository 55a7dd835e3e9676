"""Images reduced by area averaging, a few rows at a time; or interpolated at any places, by sparse
matrices of weights.

The kernel is the cubic convolution of Keys (1981) with a = -1/2, also called Catmull-Rom. A linear
kernel blurs: docs/evidence/photos.md has figures.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

import numpy as np
import scipy

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix
from numpy.typing import NDArray

BAND_BYTES = 1 << 22  # of the rows that are in memory at once, as 8-bit samples
Part = tuple[slice, slice]  # rows and columns of an image
Patch = tuple[Part, NDArray[np.bool_], Part, "csr_matrix"]
PATCH_SIDE = 192  # pixels: what is computed for a patch stays in the cache
TAPS = np.arange(-1, 3, dtype=np.int32)  # from the pixel at the left of a place, or above it


def band_rows(width: int, channels: int = 3) -> int:
    """How many rows of an image make a band."""
    return max(1, BAND_BYTES // (width * channels))


def resample(pixels: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Resample an image uint8[H, W, channels] to a size (width, height); each new pixel is the mean
    of the area that it covers.

    OpenImageIO's box filter is equal for whole ratios, but for others it gives every touched pixel
    its full weight, which shifts edges by a quarter pixel.
    """
    height, width, channels = pixels.shape
    return joined(resampled_bands([pixels], (width, height), size), size, channels)


def joined(bands: Iterable[NDArray[np.uint8]], size: tuple[int, int], channels: int = 3) -> NDArray[np.uint8]:
    """The image uint8[H, W, channels] of this size (width, height), of bands uint8[n, W, channels]
    from the top down, which are dropped one by one."""
    whole, row = np.empty((size[1], size[0], channels), np.uint8), 0
    for band in bands:
        whole[row : row + len(band)] = band
        row += len(band)
    return whole


def resampled_bands(
    bands: Iterable[NDArray[np.uint8]], old: tuple[int, int], size: tuple[int, int]
) -> Iterator[NDArray[np.uint8]]:
    """Yield the rows of `resample` of an image that arrives in bands, from the top down; they do
    not depend on the heights of the bands.

    Parameters
    ----------
    bands : uint8[n, W, channels] each, from the top down.
    old, size : (width, height) of the image and of the result.
    """
    (old_width, old_height), (width, height) = old, size
    rows_of, columns_of = _coverage(old_height, height), _coverage(old_width, width)
    waiting: list[NDArray[np.uint8]] = []  # the rows from `first` to `read`
    first = read = done = 0
    for band in bands:
        waiting.append(band)
        read += len(band)
        whole = read * height // old_height  # rows of the result that need no further band
        if whole == done:
            continue
        pixels = np.concatenate(waiting) if len(waiting) > 1 else waiting[0]
        step = band_rows(old_width)
        for begin in range(done, whole, step):
            end = min(begin + step, whole)
            low, high = begin * old_height // height, -(-end * old_height // height)
            yield _shrunk(pixels[low - first : high - first], rows_of[begin:end, low:high], columns_of)
        kept = whole * old_height // height
        waiting, first, done = [pixels[kept - first :].copy()], kept, whole


def _shrunk(pixels: NDArray[np.uint8], rows_of: csr_matrix, columns_of: csr_matrix) -> NDArray[np.uint8]:
    """uint8[height, width, channels]: sums over rows, then over columns."""
    height, width, channels = rows_of.shape[0], *pixels.shape[1:]
    rows = rows_of @ pixels.reshape(len(pixels), -1).astype(np.float32)
    columns = rows.reshape(height, width, channels).transpose(1, 0, 2).reshape(width, -1)
    mean = (columns_of @ columns).reshape(-1, height, channels)
    rounded: NDArray[np.uint8] = (mean.transpose(1, 0, 2) + 0.5).astype(np.uint8)
    return rounded


@functools.lru_cache(64)  # photos of a set have few sizes
def _coverage(old: int, new: int) -> csr_matrix:
    """Sparse float32[new, old]: the share of new pixel i that old pixel j covers; rows sum to 1."""
    # in units of 1 / (old * new) every border is an integer, so rounding moves none
    borders = np.union1d(np.arange(old + 1) * new, np.arange(new + 1) * old)
    begins, lengths = borders[:-1], np.diff(borders)
    return scipy.sparse.csr_matrix(
        ((lengths / old).astype(np.float32), (begins // old, begins // new)), shape=(new, old)
    )


def patches(places: NDArray[np.float32], size: tuple[int, int], round_trip: bool = False) -> Iterator[Patch]:
    """Yield the weights of the interpolated image, except for patches without a place: rows and
    columns of the result, bool[n, m] which of its pixels have a place, R rows and columns of the
    image on which they depend, and weights float32[S, R] of the S pixels that have a place.

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
        rectangle = slice(low[1], high[1]), slice(low[0], high[0])
        yield (
            part,
            shown,
            rectangle,
            scipy.sparse.csr_matrix(
                (weights.ravel(), indices.ravel(), begins), shape=(len(x), (high[1] - low[1]) * (high[0] - low[0]))
            ),
        )


def _kernel(f: NDArray[np.float32]) -> NDArray[np.float32]:
    """float32[N, 4]: the weights of the pixels around places at shares f [N] of the way from the
    second to the third."""
    half = np.float32(0.5)
    return half * np.stack(
        [f * (f * (2 - f) - 1), f * f * (3 * f - 5) + 2, f * (f * (4 - 3 * f) + 1), f * f * (f - 1)], axis=1
    )
