"""The way from a scene to its Partition, the same for every method."""

import numpy as np

from clsplat.partition.blockgs import blockgs
from clsplat.partition.citygs import citygs
from clsplat.partition.grid import choose_grid
from clsplat.partition.partition import Cells, Partition
from clsplat.partition.site import Site
from clsplat.partition.starved import join_starved, refuse_starved
from clsplat.partition.vastgs import vastgs

METHODS = {"citygs": citygs, "blockgs": blockgs, "vastgs": vastgs}


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
