"""The best two products of descriptors, as integers (cl/match.cl has the contract)."""

import numpy as np


def nearest(first, second):
    """Of uint8[N, 128] and [M, 128]: the row of the best product [N], and the best two [N, 2]."""
    return best_two(first.astype(np.int64) @ second.T.astype(np.int64), np.ones((len(first), len(second)), bool))


def follow(first, second, there, allowed):
    """The same of features that lie within a distance of a line or a place: `there` float[N, 3], a
    line or a homogeneous place, `allowed` (points [M, 2], is_plane, most)."""
    points, is_plane, most = allowed
    if is_plane:
        away = np.linalg.norm(points - (there[:, :2] / there[:, 2:])[:, None], axis=2)
    else:
        away = np.abs(there @ np.column_stack([points, np.ones(len(points))]).T) / np.hypot(*there[:, :2].T)[:, None]
    return best_two(first.astype(np.int64) @ second.T.astype(np.int64), away <= most)


def best_two(products, counted):
    products = np.where(counted, products, -1)
    padded = np.pad(products, ((0, 0), (0, 2)), constant_values=-1)
    index = np.argmax(padded, axis=1)
    best = np.maximum(np.sort(padded, axis=1)[:, :-3:-1], 0)
    return np.where(padded[np.arange(len(index)), index] > 0, index, -1), best


def matches(there, back, ratio=0.8):
    """[K, 2] of what both ways have in common, by the tests of ratio and angle."""

    def clear(found):
        index, best = found
        angles = np.arccos(np.minimum(best / 512**2, 1))
        return np.where((angles[:, 0] < ratio * angles[:, 1]) & (angles[:, 0] < 0.7), index, -1)

    there, back = clear(there), clear(back)
    return np.array([(row, other) for row, other in enumerate(there) if other >= 0 and back[other] == row]).reshape(
        -1, 2
    )
