"""From a scene to its Partition, in the same steps for every method."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.partition.blockgs import blockgs
from clsplat.partition.citygs import citygs
from clsplat.partition.grid import choose_grid, elongation, makespan, squarest
from clsplat.partition.input import PartitionInput
from clsplat.partition.partition import Cells, Partition
from clsplat.partition.starved import join_starved, refuse_starved
from clsplat.partition.tracks import seen_by_tracks
from clsplat.partition.vastgs import vastgs

if TYPE_CHECKING:
    from clsplat.gaussians import Gaussians
    from clsplat.partition.options import PartitionOptions
    from clsplat.partition.region import Region
    from clsplat.scene import Scene

METHODS = {"citygs": citygs, "blockgs": blockgs, "vastgs": vastgs}

MOST_BLOCKS_A_WORKER = 4  # with more, the sizes of blocks hardly matter
MOST_ELONGATED = 2.0  # sides of the cells of a finer grid: long borders are long seams
WORTH = 1.1  # a finer grid must end earlier by this

# 1 - SSIM between the render of all gaussians and that of those where the mask bool[M] is true, in
# the view with this index in scene.views
DropTest = Callable[[Iterable[tuple[int, NDArray[np.bool_]]]], Iterable[float]]


def make_partition(scene: Scene, options: PartitionOptions, gaussians: Gaussians | None = None,
                   views: ArrayLike | None = None, drop: DropTest | None = None,
                   weights: NDArray[np.float64] | None = None) -> Partition:
    """Cut a scene into blocks, and assign views to them.

    Parameters
    ----------
    scene : the whole scene.
    options : the method and its numbers.
    gaussians : a coarse model in the scene's local frame. None: the sparse points are used.
    views : indices into scene.views of the training views. None: all.
    drop : see `citygs`.
    weights : [N], how much each gaussian counts. None: all the same.

    Raises
    ------
    InputError : the grid has a starved block, or the bounds contain no points.
    """
    data = PartitionInput.of(scene, gaussians, views, options.up, options.bounds, weights)
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
    """The smallest grid that fits, or a finer one after which the workers end earlier.

    Blocks differ in work, and with one block a worker the largest decides. More of them balance
    better, but share more views.
    """
    low, high = data.content_box()
    side = np.maximum((high - low)[:2], np.finfo(float).tiny)
    aspect, needed = side[0] / side[1], options.needed
    if options.workers == 1 or needed > options.workers * MOST_BLOCKS_A_WORKER:
        return choose_grid(needed, aspect)
    most = max(needed, options.most_blocks)
    counts = range(needed, min(needed + 2 * options.workers, most) + 1)
    grids = dict.fromkeys(grid for count in counts for grid in (
        choose_grid(count, aspect), squarest(count, aspect))
        if options.method == "blockgs"  # of which only the number of cells counts
        or elongation(grid, aspect) <= MOST_ELONGATED or grid == choose_grid(needed, aspect))
    ends = {grid: makespan(expected_work(data, grid, options), options.workers)
            for grid in grids if math.prod(grid) <= most or grid == next(iter(grids))}
    return min((grid for grid in ends if ends[grid] <= WORTH * min(ends.values())), key=math.prod)


def expected_work(data: PartitionInput, grid: tuple[int, int], options: PartitionOptions
                  ) -> NDArray[np.float64]:
    """[B]: the steps of each block of a grid times what a step costs; the unit is arbitrary.

    Steps are as many as views, by the tracks of the sparse points. About half of a step's time is
    for its pixels, and does not depend on the gaussians that the block trains; which half is taken
    from the mean block.
    """
    regions, assigned = METHODS[options.method](data, grid, options, None)
    regions, *_ = join_starved(data, options, regions, assigned)
    coordinates = regions[0].space.to(data.content)
    trained = [region.grown(region.margin) for region in regions]
    gaussians = np.array([data.weights[region.holds(coordinates)].sum() for region in trained])
    views = seen_by_tracks(data, trained).sum(axis=1)
    return np.asarray(views * (data.weights.sum() / options.needed + gaussians), np.float64)


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
