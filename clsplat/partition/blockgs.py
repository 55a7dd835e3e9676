"""Recursive bisection into blocks of equal content (Wu et al. 2025, BlockGaussian)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsplat.partition.grid import best_cut
from clsplat.partition.region import Region
from clsplat.partition.tracks import seen_by_tracks

if TYPE_CHECKING:
    from clsplat.partition.input import PartitionInput
    from clsplat.partition.make import DropTest
    from clsplat.partition.options import PartitionOptions


BALANCED = 1.05  # content of the fullest block over that of the mean one
ROUNDS = 10
MOST_SAMPLED = 100_000  # of the content, to find cells


def blockgs(data: PartitionInput, grid: tuple[int, int], options: PartitionOptions,
            drop: DropTest | None = None) -> tuple[list[Region], NDArray[np.bool_]]:
    """Cut the scene into N * M cells, each cut from a larger one across its longer side.

    A cell for k blocks is cut so that its parts contain content in the ratio of k // 2 to
    k - k // 2, by weight, within the area of interest (the released code cuts at the middle). The
    content is weighted anew until blocks with their margins contain about the same. A view is
    assigned to the cells, enlarged by the margin, that its tracks see (`seen_by_tracks`).

    Returns
    -------
    The regions, and bool[B, V]: which views are assigned to each.
    """
    space = data.space()
    inside = np.flatnonzero(data.inside())
    if len(inside) > MOST_SAMPLED:
        inside = np.random.default_rng(0).choice(inside, MOST_SAMPLED, replace=False)
    coordinates, weights = space.to(data.content[inside]), data.weights[inside]
    regions = _balanced(Region(space, margin=options.margin), coordinates, weights,
                        grid[0] * grid[1])
    return regions, seen_by_tracks(data, [region.grown(region.margin) for region in regions])


def _balanced(whole: Region, coordinates: NDArray[np.float64], weights: NDArray[np.float64],
              count: int) -> list[Region]:
    """Cut a region into `count` Regions that contain about the same with their margins.

    Margins of cells with equal content contain up to twice as much in one block as in another. So
    the content of a cell counts more where its block contains more than the mean one, until the
    fullest one is near the mean; of all rounds, the one is taken whose fullest block is smallest.
    """
    found = []
    counted = weights.copy()
    for _ in range(ROUNDS):
        regions = _bisected(whole, coordinates, counted, count)
        reached = np.array([weights[region.grown(region.margin).holds(coordinates)].sum()
                            for region in regions])
        found.append((reached.max(), regions))
        if reached.max() <= BALANCED * reached.mean():
            break
        for region, content in zip(regions, reached):
            counted[region.holds(coordinates)] *= np.sqrt(content / reached.mean())
    return min(found, key=lambda pair: pair[0])[1]


def _bisected(region: Region, coordinates: NDArray[np.float64], weights: NDArray[np.float64],
              count: int) -> list[Region]:
    """Cut a region with the content `coordinates` [K, 3] into `count` Regions."""
    if count == 1:
        return [region]
    sides = (region.side * region.space.half)[:2]
    for axis in np.argsort(-sides, kind="stable"):
        at = best_cut(coordinates[:, axis], weights, count // 2 / count)
        if at is not None:
            break
    else:
        return [region]
    lower, upper = region.cut(axis, at)
    below = coordinates[:, axis] < at
    return (_bisected(lower, coordinates[below], weights[below], count // 2)
            + _bisected(upper, coordinates[~below], weights[~below], count - count // 2))
