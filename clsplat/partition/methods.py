"""The methods by which a scene is cut into cells, and views are assigned to them; they share one
signature.

citygs : a grid in contracted space (Liu et al. 2024, CityGaussian, section 3.2).
blockgs : recursive bisection into equal content (Wu et al. 2025, BlockGaussian).
vastgs : cells with equally many cameras (Lin et al. 2024, VastGaussian, section 4.1).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsplat.partition.clusters import Clusters
from clsplat.partition.input import CONTENT_QUANTILES, PartitionInput, quantiles
from clsplat.partition.partition import Cells
from clsplat.partition.region import Region, Space

if TYPE_CHECKING:
    from clsplat.camera import Camera
    from clsplat.partition.options import PartitionOptions

# of citygs
TESTED_GAUSSIANS = 25_000  # a cell with fewer, and fewer than an equal share, is enlarged to test
GROWTH_STEP = 0.01  # of contracted space, by which such a cell is enlarged
IMAGE_MARGIN = 0.1  # of the image: gaussians with a centre this far outside may still be visible
# of blockgs
BALANCED = 1.05  # content of the fullest block over that of the mean one
ROUNDS = 10
MOST_SAMPLED = 100_000  # of the content, to find cells
# of vastgs
LEAST_FILLED = 0.25  # share of the image above which a cell that fills it is assigned the view
RAYS_PER_SIDE = 16  # of the image, by which this share is measured
HEIGHT_QUANTILES = (0.01, 0.99)  # of a cell's content, from its ground to its highest point
# of tracks
LEAST_OF_VIEW = 0.3  # share of a view's points above which a cell is assigned the view
LEAST_OF_CELL = 0.1  # share of a cell's points above which a view is assigned to the cell

# 1 - SSIM between the render of all gaussians and that of those where the mask bool[M] is true, in
# the view with this index in scene.views
DropTest = Callable[[Iterable[tuple[int, NDArray[np.bool_]]]], Iterable[float]]
Cut = tuple[list[Region], NDArray[np.bool_]]  # cells, and bool[B, V]: which views each is assigned


def citygs(data: PartitionInput, grid: tuple[int, int], options: PartitionOptions,
           drop: DropTest | None = None) -> Cut:
    """Cut the scene into the cells of a uniform N x M grid along u and v, row by row.

    A view is assigned to the cell that contains its camera, and to those without whose gaussians
    `drop` is more than `options.threshold`. `drop` receives all cells of a view in turn, so that a
    view's full render is needed once. Where it is None, the tracks of the view decide
    (`seen_by_tracks`).
    """
    space = _contracted(data, grid)
    margin = options.margin
    across, along = ([-np.inf, *(np.arange(1, n) / n), np.inf] for n in grid)  # unbounded ends
    regions = [Region(space, np.array([u0, v0, -np.inf]), np.array([u1, v1, np.inf]), margin)
               for v0, v1 in zip(along, along[1:]) for u0, u1 in zip(across, across[1:])]
    cameras = space.to(data.cameras)
    assigned = np.array([region.holds(cameras) for region in regions])
    if len(regions) == 1:
        return regions, assigned
    if drop is None:
        return regions, assigned | seen_by_tracks(data, regions)
    content = space.to(data.content)
    tested = _tested(regions, content)
    owner = Cells(regions).at(content)
    pairs: list[tuple[int, int]] = []  # block, view
    for view, visible in enumerate(_visible_cells(data, owner)):
        pairs += [(block, view) for block in visible[~assigned[visible, view]].tolist()]
    inside = [region.holds(content) for region in tested]
    changes = drop((int(data.views[view]), ~inside[block]) for block, view in pairs)
    for (block, view), change in zip(pairs, changes):
        assigned[block, view] = change > options.threshold
    return regions, assigned


def _contracted(data: PartitionInput, grid: tuple[int, int]) -> Space:
    """The contracted space of the grid.

    Its area of interest is the bounds that the user set. Otherwise the area is chosen so that each
    of the outermost cells contains 1/N of the content, since cells of equal size in contracted
    space differ in content: it is the middle half of the content for up to four cells along an
    axis, less for more cells, and all of it along an axis that is not cut.
    """
    outside = [1 / max(n, 4) for n in grid]
    shares = [(share, 1 - share) if n > 1 else CONTENT_QUANTILES
              for share, n in zip(outside, grid)]
    # cell 1 of N > 3 begins at 1/N of contracted space, N/4 half sides from the middle
    return data.space(contracted=True, shares=shares, stretch=[4 * share for share in outside])


def _tested(regions: Sequence[Region], content: NDArray[np.float64]) -> list[Region]:
    """The Regions, enlarged on all sides alike, in steps, until they contain enough content."""
    enough = min(TESTED_GAUSSIANS, len(content) // len(regions))
    tested = []
    for region in regions:
        away = np.fmax(region.low - content, content - region.high).max(axis=1).clip(0)
        needed = np.partition(away, enough - 1)[enough - 1] if enough else 0
        growth = GROWTH_STEP * (np.floor(needed / GROWTH_STEP) + 1) if needed else 0
        tested.append(Region(region.space, region.low - growth, region.high + growth))
    return tested


def _visible_cells(data: PartitionInput, owner: NDArray[np.integer]
                   ) -> Iterator[NDArray[np.integer]]:
    """For each view, the cells that have content in its image or close beside it; `owner` : [M],
    the cell of each content, -1 for none."""
    places = (data.content - data.scene.offset) / data.scene.unit
    clusters = Clusters(places, np.zeros(len(places)))
    places, owner = places[clusters.order], owner[clusters.order]
    for index in data.views:
        camera = data.scene.views[index].camera
        beside_x, beside_y = IMAGE_MARGIN * camera.width, IMAGE_MARGIN * camera.height
        near = clusters.near_view(camera, 0.0, max(beside_x, beside_y))
        (x, y), depth = (each.T for each in camera.project(places[near]))
        shown = ((depth > 0) & (x > -beside_x) & (x < camera.width + beside_x)
                 & (y > -beside_y) & (y < camera.height + beside_y))
        yield np.flatnonzero(np.bincount(owner[near[shown]] + 1)[1:])


def blockgs(data: PartitionInput, grid: tuple[int, int], options: PartitionOptions,
            drop: DropTest | None = None) -> Cut:
    """Cut the scene into N * M cells, each cut from a larger one across its longer side.

    A cell for k blocks is cut so that its parts contain content in the ratio of k // 2 to
    k - k // 2, by weight, within the area of interest (the released code cuts at the middle). The
    content is weighted anew until blocks with their margins contain about the same. A view is
    assigned to the cells, enlarged by the margin, that its tracks see (`seen_by_tracks`).
    """
    space = data.space()
    inside = np.flatnonzero(data.inside())
    if len(inside) > MOST_SAMPLED:
        inside = np.random.default_rng(0).choice(inside, MOST_SAMPLED, replace=False)
    coordinates, weights = space.to(data.content[inside]), data.weights[inside]
    regions = _balanced(Region(space, margin=options.margin), coordinates, weights,
                        grid[0] * grid[1])
    return regions, seen_by_tracks(data, [region.grown(region.margin) for region in regions])


def _balanced(whole: Region, coordinates: NDArray[np.float64], weights: NDArray[np.float64],
              count: int) -> list[Region]:
    """Cut a region into `count` Regions that contain about the same with their margins.

    Margins of cells with equal content contain up to twice as much in one block as in another. So
    the content of a cell counts more where its block contains more than the mean one, until the
    fullest one is near the mean; of all rounds, the one is taken whose fullest block is smallest.
    """
    found = []
    counted = weights.copy()
    for _ in range(ROUNDS):
        regions = _bisected(whole, coordinates, counted, count)
        reached = np.array([weights[region.grown(region.margin).holds(coordinates)].sum()
                            for region in regions])
        found.append((reached.max(), regions))
        if reached.max() <= BALANCED * reached.mean():
            break
        for region, content in zip(regions, reached):
            counted[region.holds(coordinates)] *= np.sqrt(content / reached.mean())
    return min(found, key=lambda pair: pair[0])[1]


def _bisected(region: Region, coordinates: NDArray[np.float64], weights: NDArray[np.float64],
              count: int) -> list[Region]:
    """Cut a region with the content `coordinates` [K, 3] into `count` Regions."""
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


def vastgs(data: PartitionInput, grid: tuple[int, int], options: PartitionOptions,
           drop: DropTest | None = None) -> Cut:
    """Cut the scene into N strips along u with equally many cameras, and each strip into M cells.

    A view is assigned to the cells, enlarged by the margin, that contain its camera, and to those
    that are visible in it, airspace included: whose box, from the ground to the highest point,
    fills more than 0.25 of the image. (A convex box fills the share of the image whose rays meet
    the box. The hull of the projected corners is a different area where some corners lie behind
    the camera.)
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


METHODS = {"citygs": citygs, "blockgs": blockgs, "vastgs": vastgs}


def seen_by_tracks(data: PartitionInput, regions: Sequence[Region]) -> NDArray[np.bool_]:
    """Which views see each region, as bool[B, V] (SunshineWYC, BlockGaussian 2025).

    A view sees a region if more than 0.3 of the view's points lie in the region, or if more than
    0.1 of the region's points are in the view.
    """
    sees = np.zeros((len(regions), len(data.views)), bool)
    of_view = np.bincount(data.observed_views, minlength=len(data.views))
    coordinates = regions[0].space.to(data.points)
    for block, region in enumerate(regions):
        inside = region.holds(coordinates)
        shared = np.bincount(data.observed_views[inside[data.observed_points]],
                             minlength=len(data.views))
        sees[block] = (shared > LEAST_OF_VIEW * of_view) | (shared > LEAST_OF_CELL * inside.sum())
    return sees


def best_cut(values: NDArray[np.floating], weights: NDArray[np.floating], share: float
             ) -> float | None:
    """The number below which about `share` of the weight of `values` [N] lies.

    It is halfway between two neighbouring values. None if all values are equal.
    """
    distinct, inverse = np.unique(values, return_inverse=True)
    if len(distinct) < 2:
        return None
    below = np.cumsum(np.bincount(inverse.reshape(-1), weights))
    place = int(np.argmin(np.abs(below[:-1] - share * below[-1])))
    return float(distinct[place] + distinct[place + 1]) / 2
