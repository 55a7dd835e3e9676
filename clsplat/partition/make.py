"""The way from a scene to its Partition, the same for every method."""

import math
from dataclasses import dataclass

import numpy as np

from clsplat.errors import InputError
from clsplat.partition.blockgs import blockgs
from clsplat.partition.citygs import citygs
from clsplat.partition.grid import choose_grid
from clsplat.partition.partition import Cells, Partition
from clsplat.partition.site import Site
from clsplat.partition.starved import join_starved, refuse_starved
from clsplat.partition.vastgs import vastgs

METHODS = {"citygs": citygs, "blockgs": blockgs, "vastgs": vastgs}


@dataclass(frozen=True)
class PartitionOptions:
    """method: a key of METHODS; grid: (N, M) cells along u and v, or None to choose it; limit:
    gaussians that a block may hold with its margin (0: any number), expected: those of the whole
    scene at the end of training, and least_blocks, which choose it; up, bounds: see `Site.of`;
    margin: share of a cell's sides (BlockGaussian has 0.05, VastGaussian 0.2; docs/city.md);
    threshold: of citygs, 1 - SSIM; least_views, least_gaussians: a block with fewer is starved;
    starved: "refuse" a grid that starves a block, or "join" it to a neighbour, as is done with a
    chosen grid always.
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


def make_partition(scene, options, gaussians=None, views=None, drop=None):
    """The Partition of a Scene.

    gaussians: of a coarse run, in the scene's local frame, or None for the sparse points; views:
    indices into scene.views of those that train, None: all; drop: see `citygs`. Raises InputError
    for a grid that starves a block, bounds that hold no points, and an unknown method.
    """
    if options.method not in METHODS:
        raise InputError(f"--method {options.method}: wants one of {', '.join(METHODS)}")
    if options.grid is not None and min(options.grid) < 1:
        raise InputError(f"--grid {options.grid[0]}x{options.grid[1]}: wants 1 or more each way")
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
    shared = (1 + 2 * options.margin) ** 2  # of gaussians: margins hold twice
    needed = math.ceil(options.expected * shared / options.limit) if options.limit else 1
    return choose_grid(max(needed, options.least_blocks), side[0] / side[1])


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
