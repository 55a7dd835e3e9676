"""Rows by index."""

import numpy as np


def gather(values, index):
    """values[index] for values [N, ...] and index [M]; rows may repeat."""
    return np.stack([values[i] for i in index]) if len(index) else values[:0].copy()
