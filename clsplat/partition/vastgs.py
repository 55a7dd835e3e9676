"""Cells with equally many cameras; a cell is assigned the views whose image it fills enough (Lin et
al. 2024, VastGaussian, section 4.1)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsplat.partition.frame import quantiles
from clsplat.partition.grid import best_cut
from clsplat.partition.region import Region

if TYPE_CHECKING:
    from clsplat.camera import Camera
    from clsplat.partition.input import PartitionInput
    from clsplat.partition.make import DropTest
    from clsplat.partition.options import PartitionOptions
    from clsplat.partition.region import Space

LEAST_FILLED = 0.25  # share of the image above which a cell that fills it is assigned the view
RAYS_PER_SIDE = 16  # of the image, by which this share is measured
HEIGHT_QUANTILES = (0.01, 0.99)  # of a cell's content, from its ground to its highest point


def vastgs(data: PartitionInput, grid: tuple[int, int], options: PartitionOptions,
           drop: DropTest | None = None) -> tuple[list[Region], NDArray[np.bool_]]:
    """Cut the scene into N strips along u with equally many cameras, and each strip into M cells.

    A view is assigned to the cells, enlarged by the margin, that contain its camera, and to those
    that are visible in it, airspace included: whose box, from the ground to the highest point,
    fills more than 0.25 of the image. (A convex box fills the share of the image whose rays meet
    the box. The hull of the projected corners is a different area where some corners lie behind
    the camera.)

    Returns
    -------
    The regions, and bool[B, V]: which views are assigned to each.
    """
    space = data.space()
    cameras = space.to(data.cameras)
    whole = Region(space, margin=options.margin)
    regions = [cell for strip in _strips(whole, cameras, 0, grid[0])
               for cell in _strips(strip, cameras[strip.holds(cameras)], 1, grid[1])]
    content = space.to(data.content)
    assigned = np.array([region.grown(region.margin).holds(cameras) for region in regions])
    boxes = np.array([_box(region, content, data.weights) for region in regions])
    for view, index in enumerate(data.views):
        origin, rays = _rays(data, space, view, data.scene.views[index].camera)
        assigned[:, view] |= _meet(origin, rays, boxes).mean(axis=1) > LEAST_FILLED
    return regions, assigned


def _strips(region: Region, cameras: NDArray[np.float64], axis: int, count: int) -> list[Region]:
    """Cut a Region along an axis into `count` with as nearly equally many cameras as possible."""
    strips = []
    for left in range(count, 1, -1):
        at = best_cut(cameras[:, axis], np.ones(len(cameras)), 1 / left)
        if at is None:
            break
        strip, region = region.cut(axis, at)
        strips.append(strip)
        cameras = cameras[cameras[:, axis] >= at]
    return [*strips, region]


def _box(region: Region, content: NDArray[np.float64], weights: NDArray[np.float64]
         ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Low [3] and high [3] corner of a Region's content; unbounded sides end with the area."""
    inside = region.holds(content) & (weights > 0)
    low = np.maximum(region.low, -1)
    high = np.minimum(region.high, 1)
    if inside.any():
        low[2], high[2] = quantiles(content[inside, 2], weights[inside], HEIGHT_QUANTILES)
    return low, high


def _rays(data: PartitionInput, space: Space, view: int, camera: Camera
          ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Origin [3] and directions [R, 3], in the space, of rays evenly over the image."""
    across = (np.arange(RAYS_PER_SIDE) + 0.5) / RAYS_PER_SIDE
    x = (across * camera.width - camera.centre[0]) / camera.focal[0]
    y = (across * camera.height - camera.centre[1]) / camera.focal[1]
    grid = [axis.ravel() for axis in np.meshgrid(x, y)]
    rays = np.stack([*grid, np.ones(RAYS_PER_SIDE**2)], axis=1)
    return (space.to(data.cameras[view:view + 1])[0],
            rays @ camera.rotation @ space.rotation.T / space.half)


def _meet(origin: NDArray[np.float64], rays: NDArray[np.float64], boxes: NDArray[np.float64]
          ) -> NDArray[np.bool_]:
    """Which rays [R, 3] from one origin meet which boxes [B, 2, 3], by their slabs, as bool[B, R].
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        at = (boxes[:, :, None] - origin) / rays
    enter, leave = np.fmin(*at.swapaxes(0, 1)).max(axis=2), np.fmax(*at.swapaxes(0, 1)).min(axis=2)
    meets: NDArray[np.bool_] = leave >= np.maximum(enter, 0)
    return meets
