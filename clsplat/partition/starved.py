"""Starved blocks, with too few views or gaussians to train: refused, or joined to a neighbour."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.partition.partition import Cells

if TYPE_CHECKING:
    from clsplat.partition.input import PartitionInput
    from clsplat.partition.options import PartitionOptions
    from clsplat.partition.region import Region


def refuse_starved(data: PartitionInput, options: PartitionOptions, grid: tuple[int, int],
                   regions: Sequence[Region], assigned: NDArray[np.bool_]) -> None:
    """Raise InputError if a block has fewer views or gaussians than the options require."""
    counts = _counts(data, regions)
    starved = np.flatnonzero(_starved(options, counts, assigned))
    if len(starved):
        first = starved[0]
        others = f" (and {len(starved) - 1} more)" if len(starved) > 1 else ""
        raise InputError(
            f"{data.scene.name}: block {first}{others} of the {grid[0]}x{grid[1]} grid is starved: "
            f"{_contents(counts[first], assigned[first])}, it needs "
            f"{options.least_gaussians:,} and {options.least_views}; use a smaller --grid, or "
            "--starved join")


def join_starved(data: PartitionInput, options: PartitionOptions, regions: Sequence[Region],
                 assigned: NDArray[np.bool_]) -> tuple[list[Region], NDArray[np.bool_], list[str]]:
    """Join starved blocks one by one, those with the least content first.

    Each is joined to the neighbour with the least content among those with which it makes a box.
    The blocks keep their order.

    Returns
    -------
    The regions, bool[B, V] with the views that are assigned to each, and one note for each block
    that was joined or could not be.
    """
    cells, counts, views = list(regions), _counts(data, regions).tolist(), list(assigned)
    notes: list[str] = []
    alone: list[Region] = []  # starved blocks that have no such neighbour
    while len(cells) > 1:
        starved = [block for block in np.flatnonzero(_starved(options, counts, np.array(views)))
                   if cells[block] not in alone]
        if not starved:
            break
        poorest = int(min(starved, key=counts.__getitem__))
        unions = {other: union for other, region in enumerate(cells)
                  if (union := _union(cells[poorest], region)) is not None}
        contents = _contents(counts[poorest], views[poorest])
        if not unions:
            notes.append(f"a block stays starved, no neighbour makes a box with it: {contents}")
            alone.append(cells[poorest])
            continue
        other = min(unions, key=counts.__getitem__)
        first, last = min(poorest, other), max(poorest, other)
        cells[first] = unions[other]
        counts[first] += counts.pop(last)
        views[first] = views[first] | views.pop(last)
        del cells[last]
        notes.append(f"a starved block was joined to its neighbour: {contents}")
    return cells, np.array(views), notes


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


def _contents(count: int, assigned: NDArray[np.bool_]) -> str:
    return f"{count:,} gaussians and {assigned.sum()} views"


def _union(a: Region, b: Region) -> Region | None:
    """The union of two Regions that share a whole face; None for others."""
    same = (a.low == b.low) & (a.high == b.high)
    if same.sum() != 2:
        return None
    axis = int(np.argmin(same))
    if a.high[axis] != b.low[axis] and b.high[axis] != a.low[axis]:
        return None
    return replace(a, low=np.minimum(a.low, b.low), high=np.maximum(a.high, b.high))
