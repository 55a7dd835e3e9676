"""Sums of columns."""

import math

import numpy as np


def sum_columns(rows):
    """float64[W]: the columns' sums of [N, W], rounded once."""
    return np.array([math.fsum(column) for column in np.asarray(rows, np.float64).T])
