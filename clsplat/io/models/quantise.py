"""Few bits for many values: the order, quaternions, codebooks and palettes of compressed formats.
"""

import numpy as np
from numpy.typing import NDArray

MORTON_BITS = 21  # of each axis
CODEBOOK, CODEBOOK_ROUNDS = 256, 30
PALETTE_ROUNDS, MOST_SAMPLED = 3, 1 << 18
ROWS_AT_A_TIME = 1 << 12


def morton_order(positions: NDArray[np.floating]) -> NDArray[np.intp]:
    """The order int[N] along a Z-order curve: neighbours in space become neighbours in the file,
    which then compresses better."""
    if not len(positions):
        return np.zeros(0, np.intp)
    span = np.maximum(np.ptp(positions, axis=0), np.finfo(np.float64).tiny)
    cells = ((positions - positions.min(axis=0)) / span * ((1 << MORTON_BITS) - 1)).astype(
        np.uint64)
    code = np.zeros(len(positions), np.uint64)
    for bit in range(MORTON_BITS):
        for axis in range(3):
            code |= (cells[:, axis] >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")


def unit(quaternions: NDArray[np.floating]) -> NDArray[np.float64]:
    """Quaternions float64[N, 4] of unit length; zero becomes 1, 0, 0, 0."""
    values = quaternions.astype(np.float64)
    length = np.linalg.norm(values, axis=1, keepdims=True)
    return np.where(length > 0, values / np.where(length > 0, length, 1), (1.0, 0, 0, 0))


def smallest_three(quaternions: NDArray[np.floating]
                   ) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Quaternions [N, 4] of any length without their largest component, which follows from the
    others if they have unit length.

    Returns
    -------
    int[N], which component is the largest, and float64[N, 3], the others in their order, signed so
    that the largest is positive: within -1 / sqrt(2) to 1 / sqrt(2).
    """
    values = unit(quaternions)
    largest = np.abs(values).argmax(axis=1)
    values *= np.where(np.take_along_axis(values, largest[:, None], 1) < 0, -1, 1)
    return largest, values[np.arange(4) != largest[:, None]].reshape(-1, 3)


def from_smallest_three(largest: NDArray[np.integer], others: NDArray[np.float64]
                        ) -> NDArray[np.float64]:
    """The quaternions float64[N, 4] that `smallest_three` packed."""
    values = np.empty((len(others), 4))
    mask = np.arange(4) != largest[:, None]
    values[mask] = others.ravel()
    values[~mask] = np.sqrt(np.maximum(0, 1 - (others**2).sum(axis=1)))
    return values


def codebook(values: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """At most 256 numbers that stand for all values with little squared error (Lloyd's algorithm).

    Returns
    -------
    float64[256], ascending, and uint8[...], which of them stands for each value.
    """
    ordered = np.sort(values.ravel().astype(np.float64))
    if not len(ordered):
        return np.zeros(CODEBOOK), np.zeros(values.shape, np.uint8)
    sums = np.concatenate([[0], np.cumsum(ordered)])
    # half of the first numbers follow how many values there are, half how far they reach
    ranks = np.linspace(0, len(ordered) - 1, CODEBOOK // 2).astype(int)
    centres = np.sort(np.concatenate([
        ordered[ranks], np.linspace(ordered[0], ordered[-1], CODEBOOK // 2)]))
    for _ in range(CODEBOOK_ROUNDS):
        cuts = np.searchsorted(ordered, (centres[1:] + centres[:-1]) / 2)
        cuts = np.concatenate([[0], cuts, [len(ordered)]])
        count = np.diff(cuts)
        centres = np.where(count > 0, np.diff(sums[cuts]) / np.maximum(count, 1), centres)
        centres = np.maximum.accumulate(centres)  # rounding of the sums may swap neighbours
    labels = np.searchsorted((centres[1:] + centres[:-1]) / 2, values)
    return centres, labels.astype(np.uint8)


def palette(rows: NDArray[np.floating], most: int) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """At most `most` rows that stand for all rows [N, D] with little squared error (Lloyd's
    algorithm from evenly spaced rows).

    Of many rows, some are enough to find these. On 376,339 gaussians the error is 1 % above that of
    clusters which are cut in two until there are enough.

    Returns
    -------
    float32[K, D], and int[N], which of them stands for each row.
    """
    values = rows.astype(np.float32)
    if not len(values):
        return values, np.zeros(0, np.intp)
    sample = values[::-(-len(values) // MOST_SAMPLED)]
    centres = sample[np.linspace(0, len(sample) - 1, min(most, len(sample))).astype(int)]
    for _ in range(PALETTE_ROUNDS):
        # a cluster may have become empty
        labels = np.unique(_nearest(sample, centres), return_inverse=True)[1]
        count = np.bincount(labels)
        centres = np.stack([np.bincount(labels, column) / count for column in sample.T],
                           axis=1).astype(np.float32)
    return centres, _nearest(values, centres)


def _nearest(values: NDArray[np.float32], centres: NDArray[np.float32]) -> NDArray[np.intp]:
    """The nearest centre, int[N], of each row."""
    half = (centres**2).sum(axis=1) / 2
    return np.concatenate([(values[begin:begin + ROWS_AT_A_TIME] @ centres.T - half).argmax(axis=1)
                           for begin in range(0, len(values), ROWS_AT_A_TIME)])
