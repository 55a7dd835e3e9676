"""What a block of a larger scene starts from: gaussians of the coarse run, windows of its photos.

A block trains the gaussians that its region reaches: those it owns, and those in a margin, which
are the neighbours that its outer gaussians have in the whole scene. Behind them its photos show the
rest of the scene. These surroundings are frozen as the coarse run left them. If they were trained,
they would compensate for errors of the block's own gaussians, in a different way in every block:
after merging, caliterra then lost 4 dB. A gaussian that the block owns but
that extends beyond its reach, such as haze, is frozen for the same reason: every block trains its
other gaussians with the same haze. Merging drops margin and surroundings. A block reads only the
windows of its photos that show what it reaches.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.covisibility.clusters import Clusters
from clsplat.covisibility.source_views import visibility
from clsplat.gaussians import Gaussians
from clsplat.partition.region import in_parts, world_of

if TYPE_CHECKING:
    from clsplat.camera import Camera
    from clsplat.partition.region import Region
    from clsplat.scene import Scene, View

VISIBLE_DEVIATIONS = 3.0  # standard deviations from its centre within which a gaussian is visible
TRAINED_DEVIATIONS = 2.0  # that must lie within a block's reach for the block to train a gaussian

WINDOW_QUANTILES = (0.005, 0.995)  # along both axes, of the gaussians of a block that a view shows
WINDOW_MARGIN = 0.05  # share of the window's sides that is added on every side
ALIGNMENT = 16  # pixels: windows begin and end at whole pixels of smaller photos too
LEAST_SIDE = 64  # pixels
MOST_SIZES = 8  # of a block's windows: each is a recorded frame, anew after every round of growth
MOST_STEPS = 32  # of the sides of windows in a photo's longest side, so that few sizes differ
MOST_COUNTED = 20_000  # gaussians for which shares are counted
MOST_BOUNDED = 20_000  # gaussians of a block by which windows are found

SIZED_TOGETHER = 1 << 20  # gaussians whose sizes a thread finds in all views


Window = tuple[int, int, int, int]  # left, top, right, bottom, pixels


@dataclass(frozen=True, eq=False)
class BlockStart:
    """The gaussians that a block starts from, and how many gaussians of the whole are of each kind.

    Attributes
    ----------
    gaussians, indices : the model, and where its gaussians are among those of the whole, int[K].
    own, margin : in the block's cell, and in the margin around it.
    surroundings : farther away; the model holds them, frozen.
    dense : added at dense points (`filled`); they are last in the model.
    """

    gaussians: Gaussians
    indices: NDArray[np.integer]
    own: int
    margin: int
    surroundings: int
    dense: int = 0


@dataclass(frozen=True, eq=False)
class Choice:
    """Which gaussians a block holds.

    Attributes
    ----------
    indices, log_scales : int[K], ascending, and [K, 3], larger for those that stand for others too.
    owned, reached : bool[K], in the block's cell; in that or its margin.
    """

    indices: NDArray[np.integer]
    log_scales: NDArray[np.floating]
    owned: NDArray[np.bool_]
    reached: NDArray[np.bool_]


def choose_gaussians(positions: NDArray[np.floating], log_scales: NDArray[np.floating],
                     scene: Scene, region: Region, views: Sequence[View]) -> Choice:
    """Choose the gaussians that the block of a region holds.

    Surroundings that are smaller than a pixel in every view are thinned: where two standard
    deviations are s < 1 pixels, a share of s^2 of them is kept and enlarged by 1 / s, so that
    together they cover the same area (Cook et al. 2007, Stochastic simplification of aggregate
    detail). A distant part of the scene thus costs a block no more than its pixels can show.
    Leaving out all small ones would leave holes: on the sample city, where they are 1 in 14 of a
    model, the views then had a PSNR of 26 dB against the whole model, and 35 dB with thinning.

    `positions`, `log_scales` : [N, 3], in the local frame of the `scene`; `views` : of the block,
    with cameras of the size they are trained at (`Scene.reduced`)."""
    def sizes(rows: NDArray[np.integer]) -> NDArray[np.float64]:
        return largest_sizes(positions[rows].astype(np.float64),
                             np.exp(np.maximum.reduce(log_scales[rows].T)), views,
                             scene.near_plane, enough=1)

    reached = in_parts(lambda some: region.reaches(world_of(scene, some)), positions)
    owned = reached.copy()
    owned[reached] = in_parts(lambda some: region.owns(world_of(scene, some)), positions[reached])
    rest, size = np.flatnonzero(~reached), np.ones(len(positions))
    size[rest] = in_parts(sizes, rest, size=SIZED_TOGETHER).clip(0, 1)
    kept = np.flatnonzero(np.random.default_rng(0).random(len(size)) < size**2)
    return Choice(kept, (log_scales[kept] - np.log(size[kept])[:, None]).astype(log_scales.dtype),
                  owned[kept], reached[kept])


def block_start(gaussians: Gaussians, scene: Scene, region: Region, views: Sequence[View]
                ) -> BlockStart:
    """The gaussians that the block of a region starts from, of a coarse model in the local frame of
    the whole scene; see `choose_gaussians`."""
    chosen = choose_gaussians(gaussians.positions, gaussians.log_scales, scene, region, views)
    rows = {name: values[chosen.indices] for name, values in gaussians.rows.items()
            if name != "log_scales"}
    return BlockStart(Gaussians({**rows, "log_scales": chosen.log_scales}, gaussians.sh_degree),
                      chosen.indices, int(chosen.owned.sum()),
                      int((chosen.reached & ~chosen.owned).sum()), int((~chosen.reached).sum()))


def filled(start: BlockStart, dense: Gaussians, scene: Scene, region: Region, most: int = 0
           ) -> BlockStart:
    """A start with those dense gaussians, at most to `most` in all, that its region reaches and
    that stand in its gaps: where no other one of the start lies within a gaussian's deviation."""
    positions = dense.positions.astype(np.float64)
    added = np.flatnonzero(in_parts(region.reaches, world_of(scene, positions)))
    if start.gaussians.count:
        distance, _ = scipy.spatial.cKDTree(start.gaussians.positions, balanced_tree=False).query(
            positions[added], workers=-1)
        added = added[distance > np.exp(dense.log_scales[added, 0])]
    if most:
        room = max(0, most - start.gaussians.count)
        added = np.sort(np.random.default_rng(0).permutation(added)[:room])
    rows = {name: np.concatenate([values, dense.rows[name][added]])
            for name, values in start.gaussians.rows.items()}
    return replace(start, gaussians=Gaussians(rows, start.gaussians.sh_degree), dense=len(added))


def largest_sizes(positions: NDArray[np.floating], deviations: NDArray[np.floating],
                  views: Sequence[View], near: float, enough: float = np.inf
                  ) -> NDArray[np.float64]:
    """Two standard deviations of each gaussian in the view that shows it largest, in pixels; see
    `shown_sizes`. One that has the size `enough` in a view is not looked for in others."""
    largest = np.zeros(len(positions))
    clusters = Clusters(positions, VISIBLE_DEVIATIONS * deviations)
    positions, deviations = positions[clusters.order], deviations[clusters.order]
    for view in views:
        rows = clusters.near_view(view.camera, near)
        rows = rows[largest[rows] < enough]
        largest[rows] = np.maximum(largest[rows], shown_sizes(positions[rows], deviations[rows],
                                                              view.camera, near))
    largest[clusters.order] = largest.copy()
    return largest


def shown_sizes(positions: NDArray[np.floating], deviations: NDArray[np.floating], camera: Camera,
                near: float) -> NDArray[np.float64]:
    """Two standard deviations [N] of each gaussian in a view, in pixels; 0 where it is not shown.

    A view shows a gaussian at [N, 3] that is farther away than `near` and lies within
    VISIBLE_DEVIATIONS standard deviations of the image. `deviations` : [N], the largest of three.
    """
    pixels, depths = camera.project(positions)
    deviation = deviations * max(camera.focal) / np.maximum(depths, near)
    shown = (depths > near) & camera.contains(pixels, VISIBLE_DEVIATIONS * deviation)
    return np.where(shown, 2 * deviation, 0)


def trainable(scene: Scene, region: Region, positions: NDArray[np.floating],
              log_scales: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Which gaussians a block trains, as bool[N]; the others are frozen.

    These are the gaussians that its region reaches with TRAINED_DEVIATIONS standard deviations.
    `positions`, `log_scales` : [N, 3], in the local frame of the scene."""
    def trains(some: NDArray[np.floating], logs: NDArray[np.floating]) -> NDArray[np.bool_]:
        deviations = np.exp(np.maximum.reduce(logs.T).astype(np.float64))
        return region.reaches(world_of(scene, some), scene.unit * TRAINED_DEVIATIONS * deviations)

    return in_parts(trains, positions, log_scales)


def seen_pixels(scene: Scene, region: Region, views: Sequence[View]) -> int:
    """Estimate how many pixels of `views` show what a block's region reaches.

    The share of a view's pixels is the share of its sparse points that the region reaches.
    """
    points, point, view = visibility(scene, views)
    reached = region.reaches(world_of(scene, points))
    inside, all_ = (np.bincount(view, weights, len(views)) for weights in (reached[point], None))
    pixels = np.array([view.camera.width * view.camera.height for view in views])
    return int(pixels @ (inside / np.maximum(all_, 1)))


def find_windows(gaussians: Gaussians, scene: Scene, region: Region, views: Sequence[View]
                 ) -> dict[str, Window]:
    """The window of each view that shows what `region` reaches; they have few different sizes.

    Outside its window a photo shows frozen gaussians only, so the block does not read that part.
    Views without an entry are read whole: those whose window is the whole photo, and those that
    show none of these gaussians, which were assigned because their camera stands in the cell.

    Parameters
    ----------
    gaussians, scene : the coarse model, in the local frame of the whole scene.
    region, views : the block's cell and margin, and its views, of full size.
    """
    positions = gaussians.positions.astype(np.float64)
    positions = positions[in_parts(region.reaches, world_of(scene, positions))]
    positions = positions[::max(1, -(-len(positions) // MOST_BOUNDED))]
    windows, near = dict[str, Window](), scene.near_plane
    for view in views:
        size = np.array([view.camera.width, view.camera.height])
        pixels = _shown_pixels(view, positions, near)[0]
        if not len(pixels):
            continue
        low, high = np.quantile(pixels, WINDOW_QUANTILES, axis=0)
        margin = np.maximum(WINDOW_MARGIN * (high - low), (LEAST_SIDE - (high - low)) / 2)
        low = np.maximum(np.floor((low - margin) / ALIGNMENT).astype(int) * ALIGNMENT, 0)
        high = np.minimum(np.ceil((high + margin) / ALIGNMENT).astype(int) * ALIGNMENT, size)
        if (low > 0).any() or (high < size).any():
            windows[view.name] = (*low.tolist(), *high.tolist())
    return of_few_sizes(windows, views)


def _shown_pixels(view: View, positions: NDArray[np.floating], near: float
                 ) -> tuple[NDArray[np.floating], NDArray[np.bool_]]:
    """The pixels [M, 2] of the positions [N, 3] that a view shows, and which these are, [N]."""
    pixels, depths = view.camera.project(positions)
    shown = (depths > near) & view.camera.contains(pixels)
    return pixels[shown], shown


def of_few_sizes(windows: dict[str, Window], views: Sequence[View], most: int = MOST_SIZES
                 ) -> dict[str, Window]:
    """Enlarge windows until they and the whole photos have at most `most` different sizes.

    As long as there are more, those two sizes become one that adds the fewest pixels (Ward 1963,
    with pixels in place of squared distances). Sizes in photos of different sizes are not joined.
    `views` : of full size; those without a window are read whole."""
    photos = np.array([(view.camera.width, view.camera.height) for view in views]).reshape(-1, 2)
    boxes = np.array([windows.get(view.name, (0, 0, view.camera.width, view.camera.height))
                      for view in views]).reshape(-1, 4)
    low, high = boxes[:, :2], boxes[:, 2:]
    step = ALIGNMENT * max(1, photos.max(initial=0) // (MOST_STEPS * ALIGNMENT))
    sizes = np.minimum(-((low - high) // step) * step, photos)
    while True:
        kinds, kind, count = np.unique(np.hstack([photos, sizes]), axis=0, return_inverse=True,
                                       return_counts=True)
        kind = kind.ravel()  # numpy 2.0 returns a column
        photo, size = kinds[:, :2], kinds[:, 2:]
        joined = np.maximum(size[:, None], size)
        pixels = size.prod(axis=1) * count
        added = joined.prod(axis=2) * (count[:, None] + count) - pixels[:, None] - pixels
        may_join = np.triu((photo[:, None] == photo).all(axis=2), 1)
        if len(kinds) <= most or not may_join.any():
            break
        one, other = np.unravel_index(np.where(may_join, added, np.inf).argmin(), added.shape)
        sizes[np.isin(kind, (one, other))] = joined[one, other]
    start = (low + high - sizes) // (2 * ALIGNMENT) * ALIGNMENT  # around the middle
    start = np.clip(start, np.maximum(high - sizes, 0), np.minimum(low, photos - sizes))
    return {view.name: (*first.tolist(), *(first + size).tolist())
            for view, first, size, photo in zip(views, start, sizes, photos)
            if view.name in windows and (size < photo).any()}


def owned_shares(owner: NDArray[np.integer], positions: NDArray[np.floating], views: Sequence[View],
                 near: float, blocks: int) -> NDArray[np.float64]:
    """[V, B]: the share of the gaussians shown by each view, of full size, that each block owns.

    `owner` : int[N], the block of each gaussian, or -1; `positions` : [N, 3], in the views' frame.
    """
    chosen = slice(None, None, max(1, -(-len(positions) // MOST_COUNTED)))
    shares = np.zeros((len(views), blocks))
    for row, view in zip(shares, views):
        of = owner[chosen][_shown_pixels(view, positions[chosen], near)[1]]
        row += np.bincount(of[of >= 0], minlength=blocks) / max(len(of), 1)
    return shares
