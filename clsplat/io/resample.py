"""Pictures made smaller by the mean over areas, a few rows at a time."""

import numpy as np
from scipy.sparse import csr_matrix

BAND_BYTES = 1 << 24  # of the rows that are worked on at once, as 8-bit samples


def band_rows(width, channels=3):
    """How many rows a band has."""
    return max(1, BAND_BYTES // (width * channels))


def resample(pixels, size):
    """`pixels`, uint8[H, W, 3], as uint8[height, width, 3]: each is the mean of the area it covers.

    size: (width, height). OpenImageIO's box filter is the same where the ratio is whole, but
    weighs every touched pixel fully where it is not, which shifts edges by a quarter pixel.
    """
    height, width = pixels.shape[:2]
    step = band_rows(width)
    bands = (pixels[begin:begin + step] for begin in range(0, height, step))
    return resample_bands(bands, (width, height), size)


def resample_bands(bands, old, size):
    """`resample` of an image that comes in bands, uint8[n, W, 3] from the top down; old: (width,
    height). Each sum is taken in one order, so its bytes do not depend on the bands."""
    (old_width, old_height), (width, height) = old, size
    rows_of, columns_of = _coverage(old_height, height), _coverage(old_width, width)
    result = np.empty((height, width, 3), np.uint8)
    waiting, first, there, done = [], 0, 0, 0  # rows from `first` on; `there` rows were read
    for band in bands:
        waiting.append(band)
        there += len(band)
        whole = there * height // old_height  # rows of the result that nothing more comes to
        if whole == done:
            continue
        pixels = np.concatenate(waiting) if len(waiting) > 1 else waiting[0]
        step = band_rows(old_width)
        for begin in range(done, whole, step):
            end = min(begin + step, whole)
            low, high = begin * old_height // height, -(-end * old_height // height)
            result[begin:end] = _shrunk(pixels[low - first:high - first],
                                        rows_of[begin:end, low:high], columns_of)
        kept = whole * old_height // height
        waiting, first, done = [pixels[kept - first:].copy()], kept, whole
    return result


def _shrunk(pixels, rows_of, columns_of):
    """uint8[height, width, 3]: sums over rows, then over columns."""
    height, width = rows_of.shape[0], pixels.shape[1]
    rows = rows_of @ pixels.reshape(len(pixels), -1).astype(np.float32)
    columns = rows.reshape(height, width, 3).transpose(1, 0, 2).reshape(width, -1)
    mean = (columns_of @ columns).reshape(-1, height, 3)
    return (mean.transpose(1, 0, 2) + 0.5).astype(np.uint8)


def _coverage(old, new):
    """Sparse float32[new, old]: the share of new pixel i that old pixel j covers; rows sum to 1."""
    # in units of 1 / (old * new) every border is whole, so no rounding moves one
    borders = np.union1d(np.arange(old + 1) * new, np.arange(new + 1) * old)
    begins, lengths = borders[:-1], np.diff(borders)
    return csr_matrix(((lengths / old).astype(np.float32), (begins // old, begins // new)),
                      shape=(new, old))
