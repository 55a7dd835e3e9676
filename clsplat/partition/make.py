"""The way from a scene to its Partition, the same for every method."""

import math
from dataclasses import dataclass

import numpy as np

from clsplat.errors import InputError
from clsplat.partition.blockgs import blockgs
from clsplat.partition.citygs import citygs
from clsplat.partition.grid import choose_grid
from clsplat.partition.partition import Cells, Partition
from clsplat.partition.site import Site, check_bounds, check_up
from clsplat.partition.starved import join_starved, refuse_starved
from clsplat.partition.vastgs import vastgs

METHODS = {"citygs": citygs, "blockgs": blockgs, "vastgs": vastgs}
MOST_BLOCKS = 10_000
MOST_MARGIN = 10.0  # a block then trains 21 times the cell's width; 0.05 to 0.3 are published
STARVED = ("refuse", "join")


@dataclass(frozen=True)
class PartitionOptions:
    """method: a key of METHODS; grid: (N, M) cells along u and v, or None to choose it; limit:
    gaussians that a block may hold with its margin (0: any number), expected: those of the whole
    scene at the end of training, and least_blocks, which choose it; up, bounds: see `Site.of`;
    margin: share of a cell's sides (BlockGaussian has 0.05, VastGaussian 0.2; see
    docs/notebook/city.md); threshold: of citygs, 1 - SSIM; least_views, least_gaussians: a block
    with fewer is starved; starved: "refuse" a grid that starves a block, or "join" it to a
    neighbour, as is done with a chosen grid always. Raises InputError for what no scene can
    be cut with.
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

    def __post_init__(self):
        for name, least, most in (("margin", 0, MOST_MARGIN), ("threshold", 0, 2),
                                  ("least_views", 0, math.inf), ("limit", 0, math.inf)):
            value = getattr(self, name)
            if not least <= value <= most:
                asked = "block-gaussians" if name == "limit" else name.replace("_", "-")
                wish = f"at least {least}" if most == math.inf else f"{least} to {most:g}"
                raise InputError(f"--{asked} {value}: wants {wish}")
        for name, values in (("method", METHODS), ("starved", STARVED)):
            if getattr(self, name) not in values:
                raise InputError(f"--{name} {getattr(self, name)}: wants one of "
                                 f"{', '.join(values)}")
        check_up(self.up)
        check_bounds(self.bounds)
        self._check_count()

    def _check_count(self):
        """InputError for a grid of more blocks than there is to share out among them."""
        most = (max(1, self.expected // max(1, self.least_gaussians)) if self.expected
                else MOST_BLOCKS)
        if self.grid is None:
            if self.needed > MOST_BLOCKS:
                raise InputError(f"--block-gaussians {self.limit}: makes {self.needed:,} blocks, "
                                 f"of at most {MOST_BLOCKS:,}; allow more gaussians a block")
            return
        count, name = math.prod(self.grid), f"--grid {self.grid[0]}x{self.grid[1]}"
        if min(self.grid) < 1:
            raise InputError(f"{name}: wants 1 or more each way")
        if count > MOST_BLOCKS:
            raise InputError(f"{name}: makes {count:,} blocks, of at most {MOST_BLOCKS:,}; use a "
                             "smaller --grid")
        if count > most:
            raise InputError(
                f"{name}: makes {count:,} blocks, but the scene will have about "
                f"{self.expected:,} gaussians, for {most:,} blocks of {self.least_gaussians} at "
                "most; use a smaller --grid")

    @property
    def needed(self):
        """How many blocks a chosen grid has at least."""
        shared = (1 + 2 * self.margin) ** 2  # of gaussians: margins hold twice
        full = math.ceil(self.expected * shared / self.limit) if self.limit else 1
        return max(full, self.least_blocks)


def make_partition(scene, options, gaussians=None, views=None, drop=None):
    """The Partition of a Scene.

    gaussians: of a coarse run, in the scene's local frame, or None for the sparse points; views:
    indices into scene.views of those that train, None: all; drop: see `citygs`. Raises InputError
    for a grid that starves a block, and for bounds that hold no points.
    """
    site = Site.of(scene, gaussians, views, options.up, options.bounds)
    grid = options.grid or _chosen_grid(site, options)
    regions, sees = METHODS[options.method](site, grid, options, drop)
    notes = []
    if len(regions) < grid[0] * grid[1]:
        notes.append(f"{grid[0] * grid[1]} blocks were asked for, there is enough to cut for "
                     f"{len(regions)}")
    if options.grid is not None and options.starved == "refuse" and len(regions) > 1:
        refuse_starved(site, options, grid, regions, sees)
    else:
        regions, sees, joined = join_starved(site, options, regions, sees)
        notes += joined
    return Partition(options.method, tuple(regions),
                     tuple(site.views[np.flatnonzero(row)] for row in sees),
                     _dropped(site, regions, sees), tuple(notes))


def _chosen_grid(site, options):
    low, high = site.bulk()
    side = np.maximum((high - low)[:2], np.finfo(float).tiny)
    return choose_grid(options.needed, side[0] / side[1])


def _dropped(site, regions, sees):
    """{index of a view that no block takes: why}."""
    owner = Cells(regions).at(regions[0].space.to(site.points))
    reasons = {}
    for view in np.flatnonzero(~sees.any(axis=0)):
        points = np.bincount(owner[site.point[site.view == view]], minlength=len(regions))
        reasons[int(site.views[view])] = (
            f"its {points.sum():,} points lie in {(points > 0).sum()} blocks, at most "
            f"{points.max():,} in one" if points.any() else "it sees no point of the sparse model")
    return reasons
