"""How many cells, and where to cut."""

import math

import numpy as np


def choose_grid(needed, aspect):
    """(N, M): as few cells along u and v as make `needed`, near squares.

    aspect: side along u / side along v.
    """
    shapes = [(n, math.ceil(needed / n)) for n in range(1, needed + 1)]

    def cost(shape):  # cells beyond those needed, and cells that are long
        n, m = shape
        return math.log(n * m / needed) + abs(math.log(aspect * m / n))
    return min(shapes, key=cost)


def best_cut(values, weights, share):
    """The number below which `share` of the weight lies, as nearly as distinct values float64[N]
    allow: halfway between two of them. None where there are no two."""
    distinct, inverse = np.unique(values, return_inverse=True)
    if len(distinct) < 2:
        return None
    below = np.cumsum(np.bincount(inverse.reshape(-1), weights))
    place = int(np.argmin(np.abs(below[:-1] - share * below[-1])))
    return (distinct[place] + distinct[place + 1]) / 2
