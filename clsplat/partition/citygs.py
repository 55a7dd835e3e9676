"""A grid in contracted space, and views by what is missing from them without a cell (Liu et al.
2024, CityGaussian, section 3.2)."""

import numpy as np

from clsplat.partition.partition import Cells
from clsplat.partition.region import Region
from clsplat.partition.site import BULK
from clsplat.partition.tracks import seen_by_tracks

TESTED = 25_000  # gaussians: a cell with fewer is grown for the test, or to an even share of all
STEP = 0.01  # of contracted space, by which it grows
BEYOND = 0.1  # of the image: gaussians this far outside may still show


def citygs(site, grid, options, drop=None):
    """(regions, sees bool[B, V]): the cells of an even N x M grid along u and v, row by row.

    A view is given to the cell its camera stands in, and to those without which it changes by more
    than `options.threshold`: drop(index in scene.views, keep bool[M] of the gaussians) is 1 - SSIM
    between the render of all gaussians and that of the kept. It is called for all cells of a view
    in turn, so that a view's full render is needed once. Where drop is None, tracks tell instead
    (`seen_by_tracks`).
    """
    space = _contracted(site, grid)
    margin = options.margin
    across, along = (_ends(n) for n in grid)
    regions = [Region(space, (u0, v0, -np.inf), (u1, v1, np.inf), margin)
               for v0, v1 in zip(along, along[1:]) for u0, u1 in zip(across, across[1:])]
    cameras = space.to(site.cameras)
    sees = np.array([region.holds(cameras) for region in regions])
    if len(regions) == 1:
        return regions, sees
    if drop is None:
        return regions, sees | seen_by_tracks(site, regions)
    content = space.to(site.content)
    tested = _tested(regions, content)
    owner = Cells(regions).at(content)
    for view, index in enumerate(site.views):
        shown = np.unique(owner[_shown(site, site.scene.views[index].camera)])
        for block in shown[~sees[shown, view]]:
            keep = ~tested[block].holds(content)
            sees[block, view] = drop(int(index), keep) > options.threshold
    return regions, sees


def _contracted(site, grid):
    """The space. Set bounds are its area of interest; else this is chosen so that the outermost
    cells begin where 1/N of the content lies outside, as nothing in contracted space would make
    them equal: the middle half of the content for up to four cells, less for more, and all of it
    along an axis that is not cut."""
    outside = [1 / max(n, 4) for n in grid]
    shares = [(share, 1 - share) if n > 1 else BULK for share, n in zip(outside, grid)]
    # cell 1 of N > 3 begins at 1/N of contracted space, N/4 half sides from the middle
    return site.space(contracted=True, shares=shares, stretch=[4 * share for share in outside])


def _ends(count):
    """The ends of `count` cells along an axis; the outermost have none."""
    return [-np.inf, *(np.arange(1, count) / count), np.inf]


def _tested(regions, content):
    """The Regions grown evenly on all sides, in steps, until they hold enough content."""
    enough = min(TESTED, len(content) // len(regions))
    tested = []
    for region in regions:
        away = np.fmax(region.low - content, content - region.high).max(axis=1).clip(0)
        needed = np.partition(away, enough - 1)[enough - 1] if enough else 0
        grow = STEP * (np.floor(needed / STEP) + 1) if needed else 0
        tested.append(Region(region.space, region.low - grow, region.high + grow))
    return tested


def _shown(site, camera):
    """bool[M]: which content lies in a camera's image, or close beside it."""
    pixel, depth = camera.project((site.content - site.scene.offset) / site.scene.unit)
    size = np.array([camera.width, camera.height])
    return ((depth > 0) & (pixel > -BEYOND * size).all(axis=1)
            & (pixel < (1 + BEYOND) * size).all(axis=1))
