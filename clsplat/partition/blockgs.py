"""Recursive bisection into blocks of equal content (Wu et al. 2025, BlockGaussian)."""

import numpy as np

from clsplat.partition.grid import best_cut
from clsplat.partition.region import Region
from clsplat.partition.tracks import seen_by_tracks


def blockgs(site, grid, options, drop=None):
    """(regions, sees bool[B, V]): N * M cells, each cut from a larger one across its longer side.

    A cell for k blocks is cut so that its halves hold content for k // 2 and the rest, by weight,
    within the site's area of interest (the released code cuts at the middle). A view is given to
    the cells, grown by the margin, that its tracks say it sees (`seen_by_tracks`).
    """
    space = site.space()
    inside = site.inside()
    coordinates, weights = space.to(site.content[inside]), site.weights[inside]
    regions = _bisected(Region(space, margin=options.margin), coordinates, weights,
                        grid[0] * grid[1])
    return regions, seen_by_tracks(site, [region.grown(region.margin) for region in regions])


def _bisected(region, coordinates, weights, count):
    """The Regions that a region is cut into; coordinates: of the content in it."""
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
