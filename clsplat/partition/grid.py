"""How many cells, and where to cut."""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray


def choose_grid(needed: int, aspect: float) -> tuple[int, int]:
    """The smallest grid along u and v with at least `needed` cells that are nearly square.

    `aspect` is the side along u divided by the side along v.
    """
    shapes = [(n, math.ceil(needed / n)) for n in range(1, needed + 1)]

    def cost(shape: tuple[int, int]) -> float:  # of additional cells, and of elongated ones
        n, m = shape
        return math.log(n * m / needed) + abs(math.log(aspect * m / n))
    return min(shapes, key=cost)


def squarest(count: int, aspect: float) -> tuple[int, int]:
    """The grid with exactly `count` cells that are most nearly square; `aspect` as above."""
    shapes = [(n, count // n) for n in range(1, count + 1) if count % n == 0]
    return min(shapes, key=lambda shape: elongation(shape, aspect))


def elongation(grid: tuple[int, int], aspect: float) -> float:
    """The longer side of a grid's cells over the shorter one; `aspect` as above."""
    ratio = aspect * grid[1] / grid[0]
    return max(ratio, 1 / ratio)


def makespan(work: Iterable[float], workers: int) -> float:
    """When the last worker ends, if each takes the longest task that is left (Graham 1969).

    Parameters
    ----------
    work : the time of each task.
    workers : how many there are, at least 1.
    """
    ends = [0.0] * workers
    for task in sorted(work, reverse=True):
        heapq.heapreplace(ends, ends[0] + task)
    return max(ends)


def best_cut(values: NDArray[np.floating], weights: NDArray[np.floating], share: float
             ) -> float | None:
    """The number below which about `share` of the weight of `values` [N] lies.

    It is halfway between two neighbouring values. None if all values are equal.
    """
    distinct, inverse = np.unique(values, return_inverse=True)
    if len(distinct) < 2:
        return None
    below = np.cumsum(np.bincount(inverse.reshape(-1), weights))
    place = int(np.argmin(np.abs(below[:-1] - share * below[-1])))
    return float(distinct[place] + distinct[place + 1]) / 2
