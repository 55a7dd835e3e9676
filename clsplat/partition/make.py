"""Cuts a scene into blocks: which cell each owns, and which views it trains on.

citygs : a grid in contracted space (Liu et al. 2024, CityGaussian, section 3.2).
blockgs : recursive bisection into equal content (Wu et al. 2025, BlockGaussian).
vastgs : cells with equally many cameras (Lin et al. 2024, VastGaussian, section 4.1).
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.covisibility.clusters import Clusters
from clsplat.covisibility.source_views import visibility
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.partition import region as geometry
from clsplat.partition.options import PartitionOptions
from clsplat.partition.region import CONTENT_QUANTILES, Cells, Partition, Region, Space, quantiles
from clsplat.scene import Scene

LEAST_HALF_SIDE = 0.02  # of the longest half side of an area of interest
# of citygs
TESTED_GAUSSIANS = 25_000  # a cell with fewer, and fewer than an equal share, is enlarged to test
GROWTH_STEP = 0.01  # of contracted space, by which such a cell is enlarged
IMAGE_MARGIN = 0.1  # of the image: gaussians with a centre this far outside may still be visible
MOST_SOUGHT = 500_000  # gaussians by which the cells in an image are found
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


class _Input:
    """What the partition methods work on, in world coordinates; arguments as for `make_partition`.

    Attributes
    ----------
    scene, views : the whole scene, and [V]: indices into scene.views of the training views.
    cameras : [V, 3]; the positions of these views.
    content, weights : [M, 3]; the gaussians that are divided among the blocks; [M], 1, or 0 for
        those that are not finite.
    points : [P, 3]; the sparse points.
    observed_points, observed_views : [S]; the pairs (point, index into `views`) in which a view
        sees a point.
    rotation : [3, 3]; rows u, v (along the ground) and up.
    """

    def __init__(self, scene: Scene, gaussians: Gaussians, views: NDArray[np.integer]) -> None:
        self.scene, self.views = scene, views
        chosen = [scene.views[index] for index in views]
        local, self.observed_points, self.observed_views = visibility(scene, chosen)
        self.points = geometry.world_of(scene, local)
        self.cameras = geometry.world_of(scene, [view.camera.position for view in chosen])
        self.content = geometry.world_of(scene, gaussians.positions)
        self.weights = np.isfinite(self.content).all(axis=1).astype(float)
        if not self.weights.any():
            raise InputError(
                f"{scene.name}: there is nothing to divide among blocks, since the "
                "coarse model has no gaussians; train it again"
            )
        self.rotation = geometry.ground_axes(scene.up, self.content, self.weights)

    def content_box(
        self, shares: Sequence[tuple[float, float]] = 2 * (CONTENT_QUANTILES,)
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The low [3] and high [3] corner, along u, v and up in world units, of what is divided.

        Along u and v these are the quantiles `shares` of the content. Along up the box contains all
        content but outliers, and all cameras.
        """
        along = self.content @ self.rotation.T
        up = np.concatenate([quantiles(along[:, 2], self.weights, CONTENT_QUANTILES), self.cameras @ self.rotation[2]])
        low, high = np.transpose([quantiles(along[:, axis], self.weights, share) for axis, share in enumerate(shares)])
        return np.array([*low, up.min()]), np.array([*high, up.max()])

    def space(
        self,
        contracted: bool = False,
        shares: Sequence[tuple[float, float]] = 2 * (CONTENT_QUANTILES,),
        stretch: Sequence[float] = (1.0, 1.0),
    ) -> Space:
        """The Space whose area of interest is `content_box(shares)`, with its sides along u and v
        multiplied by `stretch` [2]."""
        low, high = self.content_box(shares)
        half = (high - low) / 2
        half[:2] *= stretch
        half = np.maximum(half, LEAST_HALF_SIDE * max(half.max(), np.finfo(float).tiny))
        return Space(self.rotation, (low + high) / 2 @ self.rotation, half, contracted)


def make_partition(
    scene: Scene,
    options: PartitionOptions,
    gaussians: Gaussians,
    views: NDArray[np.integer],
    drop: DropTest | None = None,
) -> Partition:
    """Cut a scene into blocks, and assign views to them; InputError if there are no gaussians.

    Parameters
    ----------
    scene, options : the whole scene; the method and its numbers.
    gaussians : a coarse model in the scene's local frame.
    views : indices into scene.views of the training views.
    drop : see `_citygs`.
    """
    data = _Input(scene, gaussians, views)
    low, high = data.content_box()
    side = np.maximum((high - low)[:2], np.finfo(float).tiny)
    grid = options.grid or choose_grid(options.blocks, side[0] / side[1])
    if options.method == "citygs":
        regions, assigned = _citygs(data, grid, options, drop)
    elif options.method == "blockgs":
        regions, assigned = _blockgs(data, math.prod(grid), options.margin)
    else:
        regions, assigned = _vastgs(data, grid, options.margin)
    regions, assigned = _join_starved(data, options, regions, assigned)
    seen = np.bincount(data.observed_views, minlength=len(data.views))
    dropped = {
        int(data.views[view]): "it shows too little of every block"
        if seen[view]
        else "it sees no point of the sparse model"
        for view in np.flatnonzero(~assigned.any(axis=0))
    }
    return Partition(
        options.method, tuple(regions), tuple(data.views[np.flatnonzero(row)] for row in assigned), dropped
    )


def choose_grid(needed: int, aspect: float) -> tuple[int, int]:
    """The smallest grid along u and v with at least `needed` cells that are nearly square.

    `aspect` is the side along u divided by the side along v.
    """
    shapes = [(n, math.ceil(needed / n)) for n in range(1, needed + 1)]

    def cost(shape: tuple[int, int]) -> float:  # of additional cells, and of elongated ones
        n, m = shape
        return math.log(n * m / needed) + abs(math.log(aspect * m / n))

    return min(shapes, key=cost)


def _join_starved(
    data: _Input, options: PartitionOptions, regions: Sequence[Region], assigned: NDArray[np.bool_]
) -> Cut:
    """Join blocks with too few gaussians or views one by one, those with the least content first.

    Each is joined to the neighbour with the least content among those with which it makes a box.
    The blocks keep their order.
    """
    cells, views, alone = list(regions), list(assigned), list[Region]()  # alone: without neighbours
    owner = Cells(cells).at(cells[0].space.to(data.content))
    counts = np.bincount(owner[owner >= 0], minlength=len(cells)).tolist()
    while len(cells) > 1:
        starved = [
            block
            for block, (cell, count, seen) in enumerate(zip(cells, counts, views))
            if (count < options.least_gaussians or seen.sum() < options.least_views) and cell not in alone
        ]
        if not starved:
            break
        poorest = min(starved, key=counts.__getitem__)
        unions = {
            other: union for other, region in enumerate(cells) if (union := _union(cells[poorest], region)) is not None
        }
        if not unions:
            alone.append(cells[poorest])
            continue
        other = min(unions, key=counts.__getitem__)
        first, last = min(poorest, other), max(poorest, other)
        cells[first] = unions[other]
        counts[first] += counts.pop(last)
        views[first] = views[first] | views.pop(last)
        del cells[last]
    return cells, np.array(views)


def _union(a: Region, b: Region) -> Region | None:
    """The union of two Regions that share a whole face; None for others."""
    same = (a.low == b.low) & (a.high == b.high)
    if same.sum() != 2:
        return None
    axis = int(np.argmin(same))
    if a.high[axis] != b.low[axis] and b.high[axis] != a.low[axis]:
        return None
    return replace(a, low=np.minimum(a.low, b.low), high=np.maximum(a.high, b.high))


def _citygs(data: _Input, grid: tuple[int, int], options: PartitionOptions, drop: DropTest | None) -> Cut:
    """Cut the scene into the cells of a uniform N x M grid along u and v, row by row.

    A view is assigned to the cell that contains its camera, and to those without whose gaussians
    `drop` is more than `options.threshold`. `drop` receives all cells of a view in turn, so that a
    view's full render is needed once. Where it is None, the tracks of the view decide.
    """
    space = _contracted(data, grid)
    across, along = ([-np.inf, *(np.arange(1, n) / n), np.inf] for n in grid)  # unbounded ends
    regions = [
        Region(space, np.array([u0, v0, -np.inf]), np.array([u1, v1, np.inf]), options.margin)
        for v0, v1 in zip(along, along[1:])
        for u0, u1 in zip(across, across[1:])
    ]
    cameras = space.to(data.cameras)
    assigned = np.array([region.holds(cameras) for region in regions])
    if len(regions) == 1:
        return regions, assigned
    if drop is None:
        return regions, assigned | _seen_by_tracks(data, regions)
    content = space.to(data.content)
    tested = _tested(regions, content)
    owner = Cells(regions).at(content)
    pairs: list[tuple[int, int]] = []  # block, view
    for view, visible in enumerate(_visible_cells(data, owner)):
        pairs += [(block, view) for block in visible[~assigned[visible, view]].tolist()]
    outside = [~region.holds(content) for region in tested]
    changes = drop((int(data.views[view]), outside[block]) for block, view in pairs)
    for (block, view), change in zip(pairs, changes):
        assigned[block, view] = change > options.threshold
    return regions, assigned


def _contracted(data: _Input, grid: tuple[int, int]) -> Space:
    """The contracted space of the grid, in which each of the outermost cells contains 1/N of the
    content, since cells of equal size in contracted space differ in content.

    Its area of interest is the middle half of the content for up to four cells along an axis, less
    for more cells, and all of it along an axis that is not cut.
    """
    outside = [1 / max(n, 4) for n in grid]
    shares = [(share, 1 - share) if n > 1 else CONTENT_QUANTILES for share, n in zip(outside, grid)]
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


def _visible_cells(data: _Input, owner: NDArray[np.integer]) -> Iterator[NDArray[np.integer]]:
    """For each view, the cells that have content in its image or close beside it; `owner` : [M],
    the cell of each content, -1 for none."""
    chosen = slice(None, None, max(1, -(-len(owner) // MOST_SOUGHT)))
    places, owner = (data.content[chosen] - data.scene.offset) / data.scene.unit, owner[chosen]
    clusters = Clusters(places)
    places, owner = places[clusters.order], owner[clusters.order]
    for index in data.views:
        camera = data.scene.views[index].camera
        beside_x, beside_y = IMAGE_MARGIN * camera.width, IMAGE_MARGIN * camera.height
        near = clusters.near_view(camera, 0.0, max(beside_x, beside_y))
        (x, y), depth = (each.T for each in camera.project(places[near]))
        shown = (
            (depth > 0)
            & (x > -beside_x)
            & (x < camera.width + beside_x)
            & (y > -beside_y)
            & (y < camera.height + beside_y)
        )
        yield np.flatnonzero(np.bincount(owner[near[shown]] + 1)[1:])


def _blockgs(data: _Input, blocks: int, margin: float) -> Cut:
    """Cut the scene into cells, each cut from a larger one across its longer side.

    A cell for k blocks is cut so that its parts contain content in the ratio of k // 2 to
    k - k // 2, by weight (the released code cuts at the middle). The content is weighted anew until
    blocks with their margins contain about the same. A view is assigned to the cells, enlarged by
    the margin, that its tracks see.
    """
    space = data.space()
    inside = np.flatnonzero(data.weights > 0)
    if len(inside) > MOST_SAMPLED:
        inside = np.random.default_rng(0).choice(inside, MOST_SAMPLED, replace=False)
    coordinates, weights = space.to(data.content[inside]), data.weights[inside]
    regions = _balanced(Region(space, margin=margin), coordinates, weights, blocks)
    return regions, _seen_by_tracks(data, [region.grown(region.margin) for region in regions])


def _balanced(
    whole: Region, coordinates: NDArray[np.float64], weights: NDArray[np.float64], count: int
) -> list[Region]:
    """Cut a region into `count` Regions that contain about the same with their margins.

    Margins of cells with equal content contain up to twice as much in one block as in another. So
    the content of a cell counts more where its block contains more than the mean one, until the
    fullest one is near the mean; of all rounds, the one is taken whose fullest block is smallest.
    """
    found = []
    counted = weights.copy()
    for _ in range(ROUNDS):
        regions = _bisected(whole, coordinates, counted, count)
        reached = np.array([weights[region.grown(region.margin).holds(coordinates)].sum() for region in regions])
        found.append((reached.max(), regions))
        if reached.max() <= BALANCED * reached.mean():
            break
        for region, content in zip(regions, reached):
            counted[region.holds(coordinates)] *= np.sqrt(content / reached.mean())
    return min(found, key=lambda pair: pair[0])[1]


def _bisected(
    region: Region, coordinates: NDArray[np.float64], weights: NDArray[np.float64], count: int
) -> list[Region]:
    """Cut a region with the content `coordinates` [K, 3] into `count` Regions."""
    if count == 1:
        return [region]
    sides = (region.side * region.space.half)[:2]
    for axis in np.argsort(-sides, kind="stable"):
        at = _best_cut(coordinates[:, axis], weights, count // 2 / count)
        if at is not None:
            break
    else:
        return [region]
    lower, upper = region.cut(axis, at)
    below = coordinates[:, axis] < at
    return _bisected(lower, coordinates[below], weights[below], count // 2) + _bisected(
        upper, coordinates[~below], weights[~below], count - count // 2
    )


def _vastgs(data: _Input, grid: tuple[int, int], margin: float) -> Cut:
    """Cut the scene into N strips along u with equally many cameras, and each strip into M cells.

    A view is assigned to the cells, enlarged by the margin, that contain its camera, and to those
    whose box, from the ground to the highest point, fills more than 0.25 of its image.
    """
    space = data.space()
    cameras, content = space.to(data.cameras), space.to(data.content)
    regions = [
        cell
        for strip in _strips(Region(space, margin=margin), cameras, 0, grid[0])
        for cell in _strips(strip, cameras, 1, grid[1])
    ]
    assigned = np.array([region.grown(margin).holds(cameras) for region in regions])
    # unbounded sides end with the area of interest
    boxes = np.array([(region.low, region.high) for region in regions]).clip(-1, 1)
    for region, box in zip(regions, boxes):
        inside = region.holds(content) & (data.weights > 0)
        if inside.any():
            box[:, 2] = quantiles(content[inside, 2], data.weights[inside], HEIGHT_QUANTILES)
    for view, index in enumerate(data.views):
        shares = _filled(data.scene.views[index].camera, cameras[view], space, boxes)
        assigned[:, view] |= shares > LEAST_FILLED
    return regions, assigned


def _strips(region: Region, cameras: NDArray[np.float64], axis: int, count: int) -> list[Region]:
    """Cut a Region along an axis into `count` with as nearly equally many cameras as possible."""
    strips = []
    for left in range(count, 1, -1):
        along = cameras[region.holds(cameras), axis]
        at = _best_cut(along, np.ones(len(along)), 1 / left)
        if at is None:
            break
        strip, region = region.cut(axis, at)
        strips.append(strip)
    return [*strips, region]


def _filled(
    camera: Camera, origin: NDArray[np.float64], space: Space, boxes: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The share [B] of the image of a camera at `origin` whose rays meet each box [B, 2, 3] of the
    space. (Projected corners would not do: some may lie behind the camera.)"""
    at = (np.arange(RAYS_PER_SIDE) + 0.5) / RAYS_PER_SIDE
    x, y = np.meshgrid(
        (at * camera.width - camera.centre[0]) / camera.focal[0],
        (at * camera.height - camera.centre[1]) / camera.focal[1],
    )
    rays = np.stack([x, y, np.ones_like(x)], axis=2).reshape(-1, 3)
    rays = rays @ camera.rotation @ space.rotation.T / space.half
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = (boxes[:, :, None] - origin) / rays
    enter = np.fmin.reduce(ends, axis=1).max(axis=2)
    leave = np.fmax.reduce(ends, axis=1).min(axis=2)
    share: NDArray[np.float64] = (leave >= np.maximum(enter, 0)).mean(axis=1)
    return share


def _seen_by_tracks(data: _Input, regions: Sequence[Region]) -> NDArray[np.bool_]:
    """Which views see each region, as bool[B, V] (SunshineWYC, BlockGaussian 2025).

    A view sees a region if more than 0.3 of the view's points lie in the region, or if more than
    0.1 of the region's points are in the view.
    """
    sees = np.zeros((len(regions), len(data.views)), bool)
    of_view = np.bincount(data.observed_views, minlength=len(data.views))
    coordinates = regions[0].space.to(data.points)
    for block, region in enumerate(regions):
        inside = region.holds(coordinates)
        shared = np.bincount(data.observed_views[inside[data.observed_points]], minlength=len(data.views))
        sees[block] = (shared > LEAST_OF_VIEW * of_view) | (shared > LEAST_OF_CELL * inside.sum())
    return sees


def _best_cut(values: NDArray[np.floating], weights: NDArray[np.floating], share: float) -> float | None:
    """The number below which about `share` of the weight of `values` [N] lies.

    It is halfway between two neighbouring values. None if all values are equal.
    """
    distinct, inverse = np.unique(values, return_inverse=True)
    if len(distinct) < 2:
        return None
    below = np.cumsum(np.bincount(inverse.reshape(-1), weights))
    place = int(np.argmin(np.abs(below[:-1] - share * below[-1])))
    return float(distinct[place] + distinct[place + 1]) / 2
