"""Prefix sums."""

import numpy as np


def exclusive_scan(values):
    """uint64[N] sums of all values before each, and the total."""
    sums = np.cumsum(values, dtype=np.uint64)
    return np.concatenate([np.zeros(1, np.uint64), sums])[:len(values)], int(sums[-1:].sum())
