"""From a scene to its Partition, in the same steps for every method."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.errors import InputError
from clsplat.partition.input import PartitionInput
from clsplat.partition.methods import METHODS, DropTest
from clsplat.partition.partition import Cells, Partition
from clsplat.partition.region import Region

if TYPE_CHECKING:
    from clsplat.gaussians import Gaussians
    from clsplat.partition.options import PartitionOptions
    from clsplat.scene import Scene


def make_partition(scene: Scene, options: PartitionOptions, gaussians: Gaussians | None = None,
                   views: ArrayLike | None = None, drop: DropTest | None = None,
                   weights: NDArray[np.float64] | None = None) -> Partition:
    """Cut a scene into blocks, and assign views to them.

    Parameters
    ----------
    scene, options : the whole scene; the method and its numbers.
    gaussians : a coarse model in the scene's local frame. None: the sparse points are used.
    views : indices into scene.views of the training views. None: all.
    drop : see `methods.citygs`.
    weights : [N], how much each gaussian counts. None: all the same.

    Raises
    ------
    InputError : the grid has a starved block, or the bounds contain no points.
    """
    data = PartitionInput.of(scene, gaussians, views, options.up, options.bounds, weights)
    low, high = data.content_box()
    side = np.maximum((high - low)[:2], np.finfo(float).tiny)
    grid = options.grid or choose_grid(options.needed, side[0] / side[1])
    regions, assigned = METHODS[options.method](data, grid, options, drop)
    if options.grid is not None and options.starved == "refuse" and len(regions) > 1:
        _refuse_starved(data, options, grid, regions, assigned)
    else:
        regions, assigned = _join_starved(data, options, regions, assigned)
    return Partition(options.method, tuple(regions),
                     tuple(data.views[np.flatnonzero(row)] for row in assigned),
                     _dropped(data, regions, assigned))


def choose_grid(needed: int, aspect: float) -> tuple[int, int]:
    """The smallest grid along u and v with at least `needed` cells that are nearly square.

    `aspect` is the side along u divided by the side along v.
    """
    shapes = [(n, math.ceil(needed / n)) for n in range(1, needed + 1)]

    def cost(shape: tuple[int, int]) -> float:  # of additional cells, and of elongated ones
        n, m = shape
        return math.log(n * m / needed) + abs(math.log(aspect * m / n))
    return min(shapes, key=cost)


def _dropped(data: PartitionInput, regions: list[Region], assigned: NDArray[np.bool_]
             ) -> dict[int, str]:
    """For each view that is assigned to no block, by its index, the reason."""
    owner = Cells(regions).at(regions[0].space.to(data.points))
    reasons = {}
    for view in np.flatnonzero(~assigned.any(axis=0)):
        seen = data.observed_points[data.observed_views == view]
        points = np.bincount(owner[seen], minlength=len(regions))
        reasons[int(data.views[view])] = (
            f"its {points.sum():,} points lie in {(points > 0).sum()} blocks, at most "
            f"{points.max():,} in one" if points.any() else "it sees no point of the sparse model")
    return reasons


def _refuse_starved(data: PartitionInput, options: PartitionOptions, grid: tuple[int, int],
                    regions: Sequence[Region], assigned: NDArray[np.bool_]) -> None:
    """Raise InputError if a block has fewer views or gaussians than the options require."""
    counts = _counts(data, regions)
    starved = np.flatnonzero(_starved(options, counts, assigned))
    if len(starved):
        first = starved[0]
        others = f" (and {len(starved) - 1} more)" if len(starved) > 1 else ""
        raise InputError(
            f"{data.scene.name}: block {first}{others} of the {grid[0]}x{grid[1]} grid is starved: "
            f"{counts[first]:,} gaussians and {assigned[first].sum()} views, it needs "
            f"{options.least_gaussians:,} and {options.least_views}; use a smaller --grid, or "
            "--starved join")


def _join_starved(data: PartitionInput, options: PartitionOptions, regions: Sequence[Region],
                  assigned: NDArray[np.bool_]) -> tuple[list[Region], NDArray[np.bool_]]:
    """Join starved blocks one by one, those with the least content first.

    Each is joined to the neighbour with the least content among those with which it makes a box.
    The blocks keep their order. Returns the regions, and bool[B, V] with the views that are
    assigned to each.
    """
    cells, counts, views = list(regions), _counts(data, regions).tolist(), list(assigned)
    alone: list[Region] = []  # starved blocks that have no such neighbour
    while len(cells) > 1:
        starved = [block for block in np.flatnonzero(_starved(options, counts, np.array(views)))
                   if cells[block] not in alone]
        if not starved:
            break
        poorest = int(min(starved, key=counts.__getitem__))
        unions = {other: union for other, region in enumerate(cells)
                  if (union := _union(cells[poorest], region)) is not None}
        if not unions:
            alone.append(cells[poorest])
            continue
        other = min(unions, key=counts.__getitem__)
        first, last = min(poorest, other), max(poorest, other)
        cells[first] = unions[other]
        counts[first] += counts.pop(last)
        views[first] = views[first] | views.pop(last)
        del cells[last]
    return cells, np.array(views)


def _counts(data: PartitionInput, regions: Sequence[Region]) -> NDArray[np.integer]:
    """How much content each block owns, as int[B]."""
    owner = Cells(regions).at(regions[0].space.to(data.content))
    return np.bincount(owner[owner >= 0], minlength=len(regions))


def _starved(options: PartitionOptions, counts: Sequence[int] | NDArray[np.integer],
             assigned: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which blocks are starved, as bool[B]."""
    starved: NDArray[np.bool_] = ((np.array(counts) < options.least_gaussians)
                                  | (assigned.sum(axis=1) < options.least_views))
    return starved


def _union(a: Region, b: Region) -> Region | None:
    """The union of two Regions that share a whole face; None for others."""
    same = (a.low == b.low) & (a.high == b.high)
    if same.sum() != 2:
        return None
    axis = int(np.argmin(same))
    if a.high[axis] != b.low[axis] and b.high[axis] != a.low[axis]:
        return None
    return replace(a, low=np.minimum(a.low, b.low), high=np.maximum(a.high, b.high))
