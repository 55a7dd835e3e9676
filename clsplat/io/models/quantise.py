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
    """Unit quaternions without their largest component, which follows from the others.

    Parameters
    ----------
    quaternions : float[N, 4], of any length.

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
    """At most `most` rows that stand for all rows [N, D] with little squared error.

    Clusters are cut in two until there are enough, and improved with Lloyd's algorithm. Of many
    rows, some are enough to find the clusters. The result depends on no random number.

    Returns
    -------
    float32[K, D], and int[N], which of them stands for each row.
    """
    values = rows.astype(np.float32)
    if not len(values):
        return values, np.zeros(0, np.intp)
    sample = values[::-(-len(values) // MOST_SAMPLED)]
    labels = _cut(sample, most)
    for _ in range(PALETTE_ROUNDS):
        labels = _nearest(sample, _moments(sample, labels)[0])
        labels = np.unique(labels, return_inverse=True)[1]  # a cluster may have become empty
    centres = _moments(sample, labels)[0].astype(np.float32)
    return centres, _nearest(values, centres)


def _cut(values: NDArray[np.float32], most: int) -> NDArray[np.intp]:
    """The labels int[N] of at most that many clusters: those with the largest error are cut first,
    at the mean of the column in which they are widest."""
    labels, clusters = np.zeros(len(values), np.intp), 1
    while clusters < most:
        mean, spread = _moments(values, labels)
        error = spread.sum(axis=1)
        wanted = np.flatnonzero(error > error.mean() / 2)
        wanted = wanted[np.argsort(-error[wanted], kind="stable")[:most - clusters]]
        place = np.full(clusters, -1)
        place[wanted] = clusters + np.arange(len(wanted))
        column = spread.argmax(axis=1)[labels]
        above = np.take_along_axis(values, column[:, None], 1)[:, 0] > mean[labels, column]
        moved = above & (place[labels] >= 0)
        labels[moved] = place[labels[moved]]
        used, labels = np.unique(labels, return_inverse=True)  # rounding may leave one empty
        if len(used) == clusters:
            break
        clusters = len(used)
    return labels


def _nearest(values: NDArray[np.float32], centres: NDArray[np.floating]) -> NDArray[np.intp]:
    """The nearest centre, int[N], of each row."""
    single = centres.astype(np.float32)
    half = (single**2).sum(axis=1) / 2
    return np.concatenate([(values[begin:begin + ROWS_AT_A_TIME] @ single.T - half).argmax(axis=1)
                           for begin in range(0, len(values), ROWS_AT_A_TIME)])


def _moments(values: NDArray[np.float32], labels: NDArray[np.intp]
             ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The mean of each cluster, float64[K, D], and the sum of squared distances from it by column,
    float64[K, D]."""
    count = np.bincount(labels)
    mean, spread = np.empty((2, len(count), values.shape[1]))
    for column, numbers in enumerate(values.astype(np.float64).T):
        mean[:, column] = np.bincount(labels, numbers) / count
        spread[:, column] = np.bincount(labels, (numbers - mean[labels, column]) ** 2)
    return mean, spread
