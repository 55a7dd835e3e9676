"""From a scene to its Partition, in the same steps for every method."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.errors import InputError
from clsplat.partition.blockgs import blockgs
from clsplat.partition.citygs import citygs
from clsplat.partition.grid import choose_grid
from clsplat.partition.input import PartitionInput, check_bounds, check_up
from clsplat.partition.partition import Cells, Partition
from clsplat.partition.starved import join_starved, refuse_starved
from clsplat.partition.vastgs import vastgs

if TYPE_CHECKING:
    from clsplat.gaussians import Gaussians
    from clsplat.partition.region import Region
    from clsplat.scene import Scene

METHODS = {"citygs": citygs, "blockgs": blockgs, "vastgs": vastgs}
MOST_BLOCKS = 10_000
MOST_MARGIN = 10.0  # a block then trains 21 times the cell's width; 0.05 to 0.3 are published
STARVED = ("refuse", "join")

# 1 - SSIM between the render of all gaussians and that of those where the mask bool[M] is true, in
# the view with this index in scene.views
DropTest = Callable[[int, NDArray[np.bool_]], float]


@dataclass(frozen=True)
class PartitionOptions:
    """The options of a partition.

    Attributes
    ----------
    method : a key of METHODS.
    grid : cells along u and v. None: it is chosen from the next three.
    limit : the most gaussians that a block may train, with its margin; 0 for any number.
    expected : gaussians of the whole scene at the end of training.
    least_blocks : the least number of blocks of a chosen grid.
    up : see `PartitionInput.of`.
    bounds : see `PartitionInput.of`.
    margin : share of a cell's sides (BlockGaussian has 0.05, VastGaussian 0.2; see
        docs/notebook/city.md).
    threshold : 1 - SSIM above which citygs assigns a view to a cell.
    least_views : a block with fewer views is starved.
    least_gaussians : a block with fewer gaussians is starved.
    starved : "refuse" a grid with a starved block, or "join" that block to a neighbour; blocks of a
        chosen grid are always joined.

    Raises
    ------
    InputError : no scene can be partitioned with these options.
    """

    method: str = "citygs"
    grid: tuple[int, int] | None = None
    limit: int = 0
    expected: int = 0
    least_blocks: int = 1
    up: tuple[float, float, float] | None = None
    bounds: tuple[float, float, float, float] | None = None
    margin: float = 0.3
    threshold: float = 0.003
    least_views: int = 8
    least_gaussians: int = 100
    starved: str = "refuse"

    def __post_init__(self) -> None:
        for name, least, most in (("margin", 0, MOST_MARGIN), ("threshold", 0, 2),
                                  ("least_views", 0, math.inf), ("limit", 0, math.inf)):
            value = getattr(self, name)
            if not least <= value <= most:
                option = "block-gaussians" if name == "limit" else name.replace("_", "-")
                valid = f"at least {least}" if most == math.inf else f"{least} to {most:g}"
                raise InputError(f"--{option} {value}: expects {valid}")
        for name, values in (("method", METHODS), ("starved", STARVED)):
            if getattr(self, name) not in values:
                raise InputError(f"--{name} {getattr(self, name)}: expects one of "
                                 f"{', '.join(values)}")
        if self.up is not None:
            check_up(self.up)
        if self.bounds is not None:
            check_bounds(self.bounds)
        self._check_count()

    def _check_count(self) -> None:
        """Raise InputError for more blocks than the scene will have gaussians for."""
        most = (max(1, self.expected // max(1, self.least_gaussians)) if self.expected
                else MOST_BLOCKS)
        if self.grid is None:
            if self.needed > MOST_BLOCKS:
                raise InputError(f"--block-gaussians {self.limit}: makes {self.needed:,} blocks, "
                                 f"more than {MOST_BLOCKS:,}; allow more gaussians in a block")
            return
        count, name = math.prod(self.grid), f"--grid {self.grid[0]}x{self.grid[1]}"
        if min(self.grid) < 1:
            raise InputError(f"{name}: expects at least 1 block along each side")
        if count > MOST_BLOCKS:
            raise InputError(f"{name}: makes {count:,} blocks, more than {MOST_BLOCKS:,}; use a "
                             "smaller --grid")
        if count > most:
            raise InputError(
                f"{name}: makes {count:,} blocks, but the scene will have about "
                f"{self.expected:,} gaussians, enough for {most:,} blocks of at least "
                f"{self.least_gaussians}; use a smaller --grid")

    @property
    def needed(self) -> int:
        """The least number of blocks of a chosen grid."""
        shared = (1 + 2 * self.margin) ** 2  # gaussians in margins belong to several blocks
        full = math.ceil(self.expected * shared / self.limit) if self.limit else 1
        return max(full, self.least_blocks)


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
