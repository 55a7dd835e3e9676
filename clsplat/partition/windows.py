"""Windows of photos that show what a block of a larger scene reaches: it reads no more of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsplat.covisibility.source_views import visibility
from clsplat.gaussians import Gaussians
from clsplat.partition.region import world_of

if TYPE_CHECKING:
    from clsplat.partition.region import Region
    from clsplat.scene import Scene, View

WINDOW_QUANTILES = (0.005, 0.995)  # along both axes, of the gaussians of a block that a view shows
WINDOW_MARGIN = 0.05  # share of the window's sides that is added on every side
ALIGNMENT = 16  # pixels: windows begin and end at whole pixels of smaller photos too
LEAST_SIDE = 64  # pixels
MOST_SIZES = 8  # of a block's windows: each is a recorded frame, anew after every round of growth
MOST_STEPS = 32  # of the sides of windows in a photo's longest side, so that few sizes differ
MOST_COUNTED = 20_000  # gaussians for which shares are counted
MOST_COMPARED = 1_000_000  # gaussians, about, of which it is found whether a block reaches them
MOST_BOUNDED = 20_000  # gaussians of a block by which windows are found

Window = tuple[int, int, int, int]  # left, top, right, bottom, pixels


def seen_pixels(scene: Scene, region: Region, views: Sequence[View]) -> int:
    """Estimate how many pixels of `views` show what a block's region reaches.

    The share of a view's pixels is the share of its sparse points that the region reaches.
    """
    points, point, view = visibility(scene, views)
    reached = region.reaches(world_of(scene, points))
    inside, all_ = (np.bincount(view, weights, len(views)) for weights in (reached[point], None))
    pixels = np.array([view.camera.width * view.camera.height for view in views])
    return int(pixels @ (inside / np.maximum(all_, 1)))


def find_windows(gaussians: Gaussians, scene: Scene, region: Region, views: Sequence[View]) -> dict[str, Window]:
    """The window of each view that shows what `region` reaches; they have few different sizes.

    Outside its window a photo shows frozen gaussians only, so the block does not read that part.
    Views without an entry are read whole: those whose window is the whole photo, and those that
    show none of these gaussians, which were assigned because their camera stands in the cell.

    Parameters
    ----------
    gaussians, scene : the coarse model, in the local frame of the whole scene.
    region, views : the block's cell and margin, and its views, of full size.
    """
    positions = gaussians.positions[:: max(1, gaussians.count // MOST_COMPARED)].astype(np.float64)
    positions = positions[region.reaches(world_of(scene, positions))]
    positions = positions[:: max(1, -(-len(positions) // MOST_BOUNDED))]
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


def _shown_pixels(
    view: View, positions: NDArray[np.floating], near: float
) -> tuple[NDArray[np.floating], NDArray[np.bool_]]:
    """The pixels [M, 2] of the positions [N, 3] that a view shows, and which these are, [N]."""
    pixels, depths = view.camera.project(positions)
    shown = (depths > near) & view.camera.contains(pixels)
    return pixels[shown], shown


def of_few_sizes(windows: dict[str, Window], views: Sequence[View], most: int = MOST_SIZES) -> dict[str, Window]:
    """Enlarge windows until they and the whole photos have at most `most` different sizes.

    As long as there are more, those two sizes become one that adds the fewest pixels (Ward 1963,
    with pixels in place of squared distances). Sizes in photos of different sizes are not joined.
    `views` : of full size; those without a window are read whole."""
    photos = np.array([(view.camera.width, view.camera.height) for view in views]).reshape(-1, 2)
    boxes = np.array([windows.get(view.name, (0, 0, view.camera.width, view.camera.height)) for view in views]).reshape(
        -1, 4
    )
    low, high = boxes[:, :2], boxes[:, 2:]
    step = ALIGNMENT * max(1, photos.max(initial=0) // (MOST_STEPS * ALIGNMENT))
    sizes = np.minimum(-((low - high) // step) * step, photos)
    while True:
        kinds, kind, count = np.unique(np.hstack([photos, sizes]), axis=0, return_inverse=True, return_counts=True)
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
    return {
        view.name: (*first.tolist(), *(first + size).tolist())
        for view, first, size, photo in zip(views, start, sizes, photos)
        if view.name in windows and (size < photo).any()
    }


def owned_shares(
    owner: NDArray[np.integer], positions: NDArray[np.floating], views: Sequence[View], near: float, blocks: int
) -> NDArray[np.float64]:
    """[V, B]: the share of the gaussians shown by each view, of full size, that each block owns.

    `owner` : int[N], the block of each gaussian, or -1; `positions` : [N, 3], in the views' frame.
    """
    chosen = slice(None, None, max(1, -(-len(positions) // MOST_COUNTED)))
    shares = np.zeros((len(views), blocks))
    for row, view in zip(shares, views):
        of = owner[chosen][_shown_pixels(view, positions[chosen], near)[1]]
        row += np.bincount(of[of >= 0], minlength=blocks) / max(len(of), 1)
    return shares
