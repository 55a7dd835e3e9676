"""What a block of a larger scene trains on: its share of the pixels, and the gaussians it is given.

A block trains the gaussians its region reaches: those it owns, and a margin, which gives its edge
the neighbours that it has in the whole. Behind them its photos show the rest of the scene. These
surroundings stay as the coarse run left them. Trained, they would come to make up for the block's
own gaussians in ways that no other block knows of: merged, caliterra then lost 4 dB
(docs/notebook/city.md).
So does a gaussian that the block owns but that covers more than its reach, such as a haze: all the
others are trained under it as it is. Merging drops margin and surroundings. Of its photos a block
reads the windows that show what it reaches.
"""

from dataclasses import dataclass, replace

import numpy as np

from clsplat.gaussians import Gaussians

WINDOW = (0.005, 0.995)  # quantiles of what a view shows of a block, along both axes
ROOM = 0.05  # of the window's sides, on every side
ALIGN = 16  # pixels: windows begin and end at whole pixels of smaller photos too
LEAST_SIDE = 64  # pixels of a window
REACH = 3.0  # standard deviations of a gaussian beyond which it is not seen
BODY = 2.0  # deviations within which a gaussian lies in a block's reach that the block may change


@dataclass(frozen=True, eq=False)
class Cut:
    """The Gaussians a block starts with, and how many of the whole are of each kind: `own` and
    `margin`, which the region reaches, `surroundings`, and those left out, `unseen` by the block's
    views or `thinned`."""

    gaussians: Gaussians
    own: int
    margin: int
    surroundings: int
    unseen: int
    thinned: int


def cut(gaussians, scene, region, views):
    """The Cut of `gaussians`, in the local frame of `scene`, for the block that owns `region`.

    views: the block's, with cameras as large as they are trained on (`Scene.reduced`). Of the
    surroundings that no view shows larger than a pixel, two standard deviations being s pixels, a
    share of s^2 is kept and made 1 / s as large: together they cover what all did (Cook et al.
    2007, Stochastic simplification of aggregate detail). So a far part of the scene costs a block
    what its pixels can show. Leaving the small ones out would leave holes: on the sample city,
    where they are 1 in 14 of a model, the views kept 26 dB of the whole's image, thinned 35.
    """
    scene = replace(scene, region=region)
    positions = gaussians.positions.astype(np.float64)
    reached = scene.reached(positions)
    own = region.owns(scene.offset + scene.unit * positions)
    rest = ~reached
    size = np.ones(len(positions))
    size[rest] = largest_sizes(positions[rest], np.exp(gaussians.log_scales[rest].max(axis=1)),
                               views, scene.near_plane).clip(0, 1)
    keeps = np.random.default_rng(0).random(len(size)) < size**2
    rows = {name: values[keeps] for name, values in gaussians.rows.items()}
    rows["log_scales"] = (rows["log_scales"] - np.log(size[keeps])[:, None]).astype(np.float32)
    unseen = int((size == 0).sum())
    return Cut(Gaussians(rows, gaussians.sh_degree), int(own.sum()), int((reached & ~own).sum()),
               int((keeps & rest).sum()), unseen, int((~keeps).sum()) - unseen)


def find_windows(gaussians, scene, region, views):
    """{name of a view: (left, top, right, bottom), pixels}: the part of each photo that shows what
    `region` reaches of the `gaussians`, for those views of which that is a part only.

    views: of full size. Beyond its window a photo teaches a block nothing: what it shows there is
    held. A view that shows none of them, for it was given for where it stands, stays whole.
    """
    positions = gaussians.positions.astype(np.float64)
    positions = positions[replace(scene, region=region).reached(positions)]
    windows = {}
    for view in views:
        camera = view.camera
        size = np.array([camera.width, camera.height])
        pixels, depths = camera.project(positions)
        shown = (depths > scene.near_plane) & (pixels > 0).all(axis=1) & (pixels < size).all(axis=1)
        if not shown.any():
            continue
        low, high = np.quantile(pixels[shown], WINDOW, axis=0)
        room = np.maximum(ROOM * (high - low), (LEAST_SIDE - (high - low)) / 2)
        low = np.maximum(np.floor((low - room) / ALIGN).astype(int) * ALIGN, 0)
        high = np.minimum(np.ceil((high + room) / ALIGN).astype(int) * ALIGN, size)
        if (low > 0).any() or (high < size).any():
            windows[view.name] = (*low.tolist(), *high.tolist())
    return windows


def largest_sizes(positions, deviations, views, near):
    """float64[N], pixels: two standard deviations of each gaussian in the view that shows it
    largest, 0 where none shows it.

    positions float64[N, 3] and deviations float[N], the largest of the three, in the views' frame.
    A view shows what is farther than `near` and within REACH deviations of its image.
    """
    largest = np.zeros(len(positions))
    for view in views:
        camera = view.camera
        pixels, depths = camera.project(positions)
        deviation = deviations * max(camera.focal) / np.maximum(depths, near)
        reach = REACH * deviation[:, None]
        shown = (depths > near) & (pixels > -reach).all(axis=1) & (
            pixels < (camera.width, camera.height) + reach).all(axis=1)
        largest[shown] = np.maximum(largest[shown], 2 * deviation[shown])
    return largest


def trainable(scene, positions, log_scales):
    """bool[N]: which gaussians, positions [N, 3] and log_scales [N, 3] in the frame of a block's
    scene, the block may change: those that lie within its reach with BODY deviations."""
    return scene.reached(positions, BODY * np.exp(log_scales.max(axis=1).astype(np.float64)))


def seen_pixels(scene, views):
    """About how many pixels of the `views` show what a block's region reaches; all, where the
    scene is no block.

    By the sparse points: a view shows the region in the share of its points that lie there.
    """
    pixels = np.array([view.camera.width * view.camera.height for view in views])
    if scene.region is None:
        return int(pixels.sum())
    reached = scene.reached(scene.points)
    if scene.observations is None:
        shown = [view.sees(scene.points) for view in scene.views]
        inside, all_ = np.array([(np.sum(seen & reached), np.sum(seen)) for seen in shown]).T
    else:
        point, view = scene.observations.T
        inside, all_ = (np.bincount(view, weights, len(scene.views))
                        for weights in (reached[point], None))
    share = dict(zip((view.name for view in scene.views), inside / np.maximum(all_, 1)))
    return int(pixels @ [share[view.name] for view in views])
