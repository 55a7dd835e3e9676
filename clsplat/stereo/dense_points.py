"""Dense points of a scene: the places on which several photos agree, merged to a number of them.

The depth of each photo comes from a plane sweep over four adjacent photos. A pixel becomes a point
if its window looks alike in two of these, and one of them has, where the point projects to, the
same depth within one percent. Points that lie in one cell are merged to their mean; cells are
as large as the number of points that is wanted allows, in pixels, so that near places get small
cells and distant ones large cells.
"""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from clsplat.covisibility.source_views import by_view, choose_source_views, visibility
from clsplat.device import Array, Device, Reading
from clsplat.io.ahead import called_ahead
from clsplat.scene import Scene, View
from clsplat.stereo.sweep import Compared, confirm, device_images, sweep

SOURCES = 4  # photos with which each is compared
PLANES = 96
BATCH = 32  # photos that are on the device together with their sources
PHOTOS_TOGETHER = 8  # whose points are merged before those of all photos, in threads
BEYOND = 0.85, 1.2  # the first and last plane, beyond the depths of the view's sparse points
LEAST_SEEN = 20  # sparse points of a view, to estimate its depths
LEAST_SCORE = 0.5  # correlation of a pixel's window
LEAST_SOURCES = 2  # of a photo that is compared, as a score is the mean of two
AGREEING = 1  # source photos that must have the same depth; two leave out borders of a flight
SAME_DEPTH = 0.01  # relative difference
LEAST_SHARE = 1 / 8  # of the points that cells have in the mean: with fewer, it is no surface
SPARSE = 10  # points of pixels that a sparse point counts for, as it is more exact
AROUND = 0.5  # of the extent of the sparse points, on each side: what is kept
THINNEST = 0.1  # of the largest extent, which a flat scene has at least along each axis
MOST_SIZES = 20  # of cells that are tried
SAME_SIZE = 1.01  # ratio of two sizes of cells that count as one
FILLED = 0.98  # of the cells that are wanted: a size that gives so many is good enough
LARGEST_CELL = 2.0**20  # pixels
Floats = NDArray[np.float64]
Item = TypeVar("Item")
Cells = tuple[NDArray[np.int64], NDArray[np.number]]  # see `_cells`
DepthMap = tuple[NDArray[np.float32], NDArray[np.bool_]]  # see `_depth_maps`


class Points(NamedTuple):
    """Points with colours."""

    positions: Floats  # [N, 3], world
    colours: Floats  # [N, 3], 0 to 255
    sizes: Floats  # [N], world units: of a pixel there, in the photo that shows it
    merged: NDArray[np.integer]  # [N], how many points each is the mean of

    @classmethod
    def joined(cls, some: Sequence[Points]) -> Points:
        """The points of several, in their order."""
        return cls._make(map(np.concatenate, zip(*some)))

    def chosen(self, which: NDArray[np.bool_]) -> Points:
        """Some of the points."""
        return Points._make(values[which] for values in self)


def sweep_seconds(
    device: Device,
    scene: Scene,
    views: Sequence[View],
    photos_of: Callable[[Sequence[View]], Sequence[NDArray[np.uint8]]],
) -> float:
    """About how long the sweeps of all views take, by that of one of them; `photos_of` reads the
    photos of views."""
    number, others = next(
        ((number, sources) for number, sources in enumerate(stereo_views(scene, views)) if sources), (0, [])
    )
    chosen = [views[each] for each in (number, *others)]
    photos, between = photos_of(chosen), _depth_ranges(chosen, *visibility(scene, chosen))
    sources = [list(range(1, len(chosen))), *([] for _ in others)]
    for _ in range(2):  # the first one compiles
        begin = time.perf_counter()
        _depth_maps(device, sources, chosen, photos, between)
        seconds = time.perf_counter() - begin
    return len(views) * seconds


def stereo_views(scene: Scene, views: Sequence[View]) -> list[list[int]]:
    """For each view the indices of those with which it is compared; none where they are too few."""
    chosen: list[list[int]] = [sources.tolist() for sources in choose_source_views(scene, views, SOURCES)]
    return [sources if len(sources) >= LEAST_SOURCES else [] for sources in chosen]


def dense_points(
    device: Device,
    scene: Scene,
    views: Sequence[View],
    photos: Sequence[NDArray[np.uint8]],
    most: int,
    progress: Callable[[int], object] = lambda done: None,
    sources: Sequence[Sequence[int]] | None = None,
) -> tuple[Points, float]:
    """Points of a scene, the sparse points among them, and the size of the cells whose points were
    merged, pixels.

    `photos` are uint8[3, h, w] of the views, or uint8[4, h, w] with a mask, and the views' cameras
    have their size. As many points as `most` are wanted; they are fewer if photos show fewer or
    are too small. `progress` is called with the number of views that are done; `sources` are the
    `stereo_views`, if they are known.
    """
    sources = sources or stereo_views(scene, views)
    seen = visibility(scene, views)
    maps = _depth_maps(device, sources, views, photos, _depth_ranges(views, *seen), progress)
    low, high = np.percentile(scene.points, (0.5, 99.5), axis=0)
    extent = high - low
    around = AROUND * np.maximum(extent, THINNEST * extent.max())

    def points_of(*shown: tuple[View, NDArray[np.uint8], NDArray[np.float32]]) -> Points:
        """The points of a few photos, merged."""
        part = Points.joined([_points_of(*each) for each in shown])
        inside = (part.positions > low - around) & (part.positions < high + around)
        return _in_cells(part.chosen(inside.all(axis=1)), 1.0)

    threads = os.cpu_count() or 1
    parts = called_ahead(
        points_of, _by(PHOTOS_TOGETHER, zip(views, photos, _confirmed(device, sources, views, maps))), threads, threads
    )
    return merge(Points.joined([*parts, _sparse(scene, views, *seen)]), most)


def _by(count: int, items: Iterable[Item]) -> Iterator[tuple[Item, ...]]:
    """The items, so many at a time."""
    items = iter(items)
    while some := tuple(islice(items, count)):
        yield some


def _depth_ranges(
    views: Sequence[View], points: Floats, point: NDArray[np.integer], seen_by: NDArray[np.integer]
) -> list[tuple[float, float] | None]:
    """For each view the depths of the nearest and the farthest plane; None where too few sparse
    points show. For the other arguments see `visibility`."""
    result: list[tuple[float, float] | None] = []
    for view, seen in zip(views, by_view(point, seen_by, len(views))):
        _, depth = view.camera.project(points[seen])
        depth = depth[depth > 0]
        near, far = np.percentile(depth, (1, 99)) * BEYOND if len(depth) >= LEAST_SEEN else (0.0, 0.0)
        result.append((float(near), float(far)) if near > 0 else None)
    return result


def _depth_maps(
    device: Device,
    sources: Sequence[Sequence[int]],
    views: Sequence[View],
    photos: Sequence[NDArray[np.uint8]],
    between: Sequence[tuple[float, float] | None],
    progress: Callable[[int], object] = lambda done: None,
) -> list[DepthMap]:
    """The inverse depths of all pixels of each view [h, w], 0 where there is none, and bool[h, w],
    which of them look alike in two sources; the others may still confirm those of another view.
    A view without sources or `between`, the depths of its first and last plane, has none."""
    maps = [(np.zeros(photo.shape[1:], np.float32), np.zeros(photo.shape[1:], np.bool_)) for photo in photos]

    def launch(number: int, compared: Compared) -> tuple[Array, ...]:
        planes = between[number]
        return sweep(compared, (1 / planes[1], 1 / planes[0]), PLANES) if planes else ()

    for number, found in _compared(device, sources, views, lambda number: _grey(photos[number]), launch):
        if found:
            inverse, score = found
            maps[number] = np.maximum(inverse, 0), score > LEAST_SCORE
        progress(number + 1)
    return maps


def _compared(
    device: Device,
    sources: Sequence[Sequence[int]],
    views: Sequence[View],
    image_of: Callable[[int], NDArray[np.floating]],
    launch: Callable[[int, Compared], Sequence[Array]],
) -> Iterator[tuple[int, list[NDArray[Any]]]]:
    """The index of each view, and on the host what `launch` leaves for it [h, w], which is called
    for views with sources; images [h, w] of BATCH views and their sources are on the device at a
    time. The next view is launched before the host waits for one: the device always has work."""
    ahead = deque[tuple[int, list[Reading]]]()

    def next_one() -> tuple[int, list[NDArray[Any]]]:
        number, readings = ahead.popleft()
        camera = views[number].camera
        return number, [reading.values()[: camera.height, : camera.width] for reading in readings]

    for first in range(0, len(sources), BATCH):
        some = range(first, min(first + BATCH, len(sources)))
        together = sorted({*some, *(source for number in some for source in sources[number])})
        images, sizes = device_images(device, [image_of(number) for number in together])
        cameras = [views[number].camera for number in together]
        # of all views before the first launch, for which their upload would wait
        compared = [
            Compared.of(
                images, sizes, cameras, together.index(number), [together.index(source) for source in sources[number]]
            )
            for number in some
        ]
        for number, each in zip(some, compared):
            arrays = launch(number, each) if sources[number] else ()
            ahead.append((number, [Reading(array) for array in arrays]))
            if len(ahead) > 1:
                yield next_one()
    while ahead:
        yield next_one()


def _grey(photo: NDArray[np.uint8]) -> Floats:
    """The mean of the colours, 0 to 1, nan where a pixel does not count."""
    grey: Floats = photo[:3].mean(axis=0) / 255
    grey[(photo[3:] == 0).any(axis=0)] = np.nan
    return grey


def _confirmed(
    device: Device, sources: Sequence[Sequence[int]], views: Sequence[View], maps: Sequence[DepthMap]
) -> Iterator[NDArray[np.float32]]:
    """For each view the inverse depths of the pixels that become points [h, w], or 0: they look
    alike in two sources, and enough sources confirm their depth."""

    def launch(number: int, compared: Compared) -> tuple[Array, ...]:
        return (confirm(compared, SAME_DEPTH),) if maps[number][1].any() else ()

    for number, found in _compared(device, sources, views, lambda number: maps[number][0], launch):
        inverse, alike = maps[number]
        for count in found:
            alike = alike & (count >= AGREEING)
        yield np.where(alike, inverse, np.float32(0))


def _points_of(view: View, photo: NDArray[np.uint8], inverse: NDArray[np.float32]) -> Points:
    """The points of a view's pixels that have an inverse depth; they have one where it is not 0."""
    camera = view.camera
    row, column = np.nonzero(inverse)
    z = 1 / inverse[row, column].astype(np.float64)
    x, y = ((place + 0.5 - centre) / focal for place, centre, focal in zip((column, row), camera.centre, camera.focal))
    world = (np.stack([x * z, y * z, z], axis=1) - camera.translation) @ camera.rotation
    return Points(world, photo[:3, row, column].T.astype(np.float64), z / np.mean(camera.focal), np.ones(len(z), int))


def _sparse(
    scene: Scene, views: Sequence[View], points: Floats, point: NDArray[np.integer], seen_by: NDArray[np.integer]
) -> Points:
    """The sparse points; for the other arguments see `visibility`."""
    sizes = np.full(len(scene.points), np.inf)
    if len(points) == len(scene.points):  # not a sample of them
        for view, seen in zip(views, by_view(point, seen_by, len(views))):
            _, depth = view.camera.project(points[seen])
            np.minimum.at(sizes, seen, np.maximum(depth, 0) / np.mean(view.camera.focal))
    known = np.isfinite(sizes) & (sizes > 0)
    sizes[~known] = np.median(sizes[known]) if known.any() else 1.0
    return Points(scene.points, scene.colours.astype(np.float64), sizes, np.full(len(scene.points), SPARSE))


def merge(points: Points, most: int) -> tuple[Points, float]:
    """Merge the points of each cell to their mean; returns the size of a cell, pixels, as well.
    Cells are at least a pixel large, and at most `most`, unless cells of LARGEST_CELL pixels are
    more."""
    merged = _in_cells(points, 1.0)
    if not len(merged.sizes):
        return merged, 1.0
    # the largest number of cells so far that is not too many: its size, and what `_cells` found
    fitting: tuple[float, Cells | None] | None = None
    low, size, high = 1.0, 1.0, LARGEST_CELL
    cells: Cells | None = None
    number: NDArray[np.number] = merged.merged  # in cells of one pixel
    for _ in range(MOST_SIZES):
        count = np.count_nonzero(_are_surface(number))
        if count <= most:
            fitting, high = (size, cells), size
            if size == 1.0 or count >= FILLED * most:
                break
        else:
            low = size
        if high < SAME_SIZE * low:  # the number jumps where one more point is needed in a cell
            break
        # a surface has cells in proportion to size ** -2
        size *= np.sqrt(count / (most * (1 + FILLED) / 2))
        if not low < size < high:
            size = np.sqrt(low * high)
        cells = _cells(merged, size)
        number = cells[1]
    size, cells = fitting or (LARGEST_CELL, None)
    found = _means(merged, *(cells or _cells(merged, size)))
    return found.chosen(_are_surface(found.merged)), size


def coarser(points: Points, pixels: float) -> tuple[Points, NDArray[np.int64]]:
    """Merge points of equal weight in cells of so many pixels; returns also int64[N], the new point
    that each became a part of."""
    alike = points._replace(merged=np.ones(len(points.sizes), int))
    of, total = _cells(alike, pixels)
    return _means(alike, of, total), of


def _are_surface(merged: NDArray[np.number]) -> NDArray[np.bool_]:
    """Whether points are on a surface, by how many were merged to each: beside it are few."""
    found: NDArray[np.bool_] = merged >= LEAST_SHARE * merged.mean()
    return found


def _in_cells(points: Points, pixels: float) -> Points:
    """The means of the points in cells of so many pixels, whose sizes are rounded to powers of 2.

    The means of means are the same, as a cell holds the mean of its points.
    """
    return _means(points, *_cells(points, pixels)) if len(points.sizes) else points


def _means(points: Points, of: NDArray[np.int64], total: NDArray[np.number]) -> Points:
    """The means of the points of each cell, from what `_cells` found."""
    weights = points.merged.astype(np.float64)

    def mean(values: Floats) -> Floats:
        return np.stack([np.bincount(of, weights * column) / total for column in values.T], axis=1)

    return Points(mean(points.positions), mean(points.colours), mean(points.sizes[:, None])[:, 0], total.astype(int))


def _cells(points: Points, pixels: float) -> Cells:
    """The cell of each point, and how many were merged to each cell; see `_in_cells`."""
    octave = np.rint(np.log2(points.sizes))
    side = np.ldexp(pixels, octave.astype(np.int32))
    place = [octave, *(column / side for column in points.positions.T)]
    for column in place:
        np.floor(column, out=column)
        column -= column.min()
    widths = [column.max() + 1 for column in place]
    if np.prod(widths) * len(octave) < 2.0**61:
        keys = np.zeros(len(octave), np.int64)
        for column, width in zip(place, widths):
            keys *= int(width)
            keys += column.astype(np.int64)
        of = _numbered(keys)
    else:  # far-off points
        of = np.unique(np.stack(place, axis=1), axis=0, return_inverse=True)[1].reshape(-1)
    return of, np.bincount(of, points.merged.astype(np.float64))


def _numbered(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """As np.unique(keys, return_inverse=True)[1], in less than half of the time.

    Keys times their number are below 2^61: each is sorted together with its place, as sorting
    numbers is several times as fast as finding their order.
    """
    count, bits = len(keys), len(keys).bit_length()
    together = np.sort(keys << bits | np.arange(count))
    keys, place = together >> bits, together & (1 << bits) - 1
    number = np.empty(count, np.int64)
    number[place] = np.cumsum(np.concatenate([[False], keys[1:] != keys[:-1]]))
    return number
