"""From a scene to its Partition, in the same steps for every method."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.partition.blockgs import blockgs
from clsplat.partition.citygs import citygs
from clsplat.partition.grid import choose_grid
from clsplat.partition.input import PartitionInput
from clsplat.partition.partition import Cells, Partition
from clsplat.partition.starved import join_starved, refuse_starved
from clsplat.partition.vastgs import vastgs

if TYPE_CHECKING:
    from clsplat.gaussians import Gaussians
    from clsplat.partition.options import PartitionOptions
    from clsplat.partition.region import Region
    from clsplat.scene import Scene

METHODS = {"citygs": citygs, "blockgs": blockgs, "vastgs": vastgs}

# 1 - SSIM between the render of all gaussians and that of those where the mask bool[M] is true, in
# the view with this index in scene.views
DropTest = Callable[[int, NDArray[np.bool_]], float]


def make_partition(scene: Scene, options: PartitionOptions, gaussians: Gaussians | None = None,
                   views: ArrayLike | None = None, drop: DropTest | None = None) -> Partition:
    """Cut a scene into blocks, and assign views to them.

    Parameters
    ----------
    scene : the whole scene.
    options : the method and its numbers.
    gaussians : a coarse model in the scene's local frame. None: the sparse points are used.
    views : indices into scene.views of the training views. None: all.
    drop : see `citygs`.

    Raises
    ------
    InputError : the grid has a starved block, or the bounds contain no points.
    """
    data = PartitionInput.of(scene, gaussians, views, options.up, options.bounds)
    grid = options.grid or _chosen_grid(data, options)
    regions, assigned = METHODS[options.method](data, grid, options, drop)
    notes = []
    if len(regions) < grid[0] * grid[1]:
        notes.append(f"{grid[0] * grid[1]} blocks were requested, but the scene can only be cut "
                     f"into {len(regions)}")
    if options.grid is not None and options.starved == "refuse" and len(regions) > 1:
        refuse_starved(data, options, grid, regions, assigned)
    else:
        regions, assigned, joined = join_starved(data, options, regions, assigned)
        notes += joined
    return Partition(options.method, tuple(regions),
                     tuple(data.views[np.flatnonzero(row)] for row in assigned),
                     _dropped(data, regions, assigned), tuple(notes))


def _chosen_grid(data: PartitionInput, options: PartitionOptions) -> tuple[int, int]:
    low, high = data.content_box()
    side = np.maximum((high - low)[:2], np.finfo(float).tiny)
    return choose_grid(options.needed, side[0] / side[1])


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
