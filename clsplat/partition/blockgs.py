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


def blockgs(data: PartitionInput, grid: tuple[int, int], options: PartitionOptions,
            drop: DropTest | None = None) -> tuple[list[Region], NDArray[np.bool_]]:
    """Cut the scene into N * M cells, each cut from a larger one across its longer side.

    A cell for k blocks is cut so that its parts contain content in the ratio of k // 2 to
    k - k // 2, by weight, within the area of interest (the released code cuts at the middle). A
    view is assigned to the cells, enlarged by the margin, that its tracks see (`seen_by_tracks`).

    Returns
    -------
    The regions, and bool[B, V]: which views are assigned to each.
    """
    space = data.space()
    inside = data.inside()
    coordinates, weights = space.to(data.content[inside]), data.weights[inside]
    regions = _bisected(Region(space, margin=options.margin), coordinates, weights,
                        grid[0] * grid[1])
    return regions, seen_by_tracks(data, [region.grown(region.margin) for region in regions])


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
