"""Stable sort."""

import numpy as np


def sort_order(keys):
    """int64[N]: the order that sorts `keys` upwards; equal keys keep theirs."""
    return np.argsort(keys, kind="stable")
