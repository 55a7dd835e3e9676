"""Cells of equally many cameras, and views by how much of the image a cell fills (Lin et al. 2024,
VastGaussian, section 4.1)."""

import numpy as np

from clsplat.partition.frame import quantiles
from clsplat.partition.grid import best_cut
from clsplat.partition.region import Region

FILLS = 0.25  # of the image: a view that a cell fills more of is given to it
RAYS = 16  # along each side of the image, by which its share is measured
HEIGHTS = (0.01, 0.99)  # quantiles of a cell's content between ground and highest point


def vastgs(site, grid, options, drop=None):
    """(regions, sees bool[B, V]): N strips along u of equally many cameras, each cut into M cells.

    A cell is given the cameras that stand in it grown by the margin, and those it is visible to,
    airspace included: whose image the cell's box, from its ground to its highest point, fills by
    more than 0.25. (The share of an image that a convex box fills is the share of its rays that
    meet the box; the hull of the projected corners is not that where some are behind the camera.)
    """
    space = site.space()
    cameras = space.to(site.cameras)
    whole = Region(space, margin=options.margin)
    regions = [cell for strip in _strips(whole, cameras, 0, grid[0])
               for cell in _strips(strip, cameras[strip.holds(cameras)], 1, grid[1])]
    content = space.to(site.content)
    sees = np.array([region.grown(region.margin).holds(cameras) for region in regions])
    boxes = np.array([_box(region, content, site.weights) for region in regions])
    for view, index in enumerate(site.views):
        origin, rays = _rays(site, space, view, site.scene.views[index].camera)
        sees[:, view] |= _meet(origin, rays, boxes).mean(axis=1) > FILLS
    return regions, sees


def _strips(region, cameras, axis, count):
    """A Region cut along an axis into `count` of as equally many cameras [K, 3] as can be."""
    strips = []
    for left in range(count, 1, -1):
        at = best_cut(cameras[:, axis], np.ones(len(cameras)), 1 / left)
        if at is None:
            break
        strip, region = region.cut(axis, at)
        strips.append(strip)
        cameras = cameras[cameras[:, axis] >= at]
    return [*strips, region]


def _box(region, content, weights):
    """(low, high) float64[3] of what a Region's content fills; endless sides end with the area."""
    inside = region.holds(content) & (weights > 0)
    low = np.maximum(region.low, -1)
    high = np.minimum(region.high, 1)
    if inside.any():
        low[2], high[2] = quantiles(content[inside, 2], weights[inside], HEIGHTS)
    return low, high


def _rays(site, space, view, camera):
    """(origin float64[3], directions float64[RAYS^2, 3]) in the space, evenly over the image."""
    across = (np.arange(RAYS) + 0.5) / RAYS
    x = (across * camera.width - camera.centre[0]) / camera.focal[0]
    y = (across * camera.height - camera.centre[1]) / camera.focal[1]
    rays = np.stack([*(axis.ravel() for axis in np.meshgrid(x, y)), np.ones(RAYS**2)], axis=1)
    return (space.to(site.cameras[view:view + 1])[0],
            rays @ camera.rotation @ space.rotation.T / space.half)


def _meet(origin, rays, boxes):
    """bool[B, R]: which rays [R, 3] from one origin meet which boxes [B, 2, 3], by their slabs."""
    with np.errstate(divide="ignore", invalid="ignore"):
        at = (boxes[:, :, None] - origin) / rays
    enter, leave = np.fmin(*at.swapaxes(0, 1)).max(axis=2), np.fmax(*at.swapaxes(0, 1)).min(axis=2)
    return leave >= np.maximum(enter, 0)
