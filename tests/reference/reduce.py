"""Sums of columns, and of arrays."""

import math

import numpy as np


def sum_columns(rows):
    """float64[W]: the columns' sums of [N, W], rounded once."""
    return np.array([math.fsum(column) for column in np.asarray(rows, np.float64).T])


def add_to(totals, values):
    """float64: the sums, element by element."""
    return np.asarray(totals, np.float64) + np.asarray(values, np.float64)
