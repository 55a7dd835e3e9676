"""The mean gradient of several views, by row."""

import numpy as np


def batch_mean(spread, seen, stays):
    """(rows seen by any view, bool[N] whether each of those may move, their mean gradient).

    Of B views: spread[B, N, W], zero where a view has no gradient; seen[B, N], stays[B, N]: bool.
    """
    any_view = np.flatnonzero(seen.any(axis=0))
    return any_view, ~stays.any(axis=0)[any_view], spread.mean(axis=0)[any_view]
