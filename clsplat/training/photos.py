"""Training photos at each level: on the device while they fit, else in host memory or a file.

A photo is decoded once a level, and not again at each of its uses: a photo of 50 megapixels takes
about a second to decode, and a twentieth of that to read from such a file.
"""

import math
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from io import BytesIO
from itertools import chain
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.device import Array, ArraySpec, Device
from clsplat.io.ahead import called_ahead
from clsplat.io.photos.resample import BAND_BYTES
from clsplat.io.photos.views import photo_bands, read_valid
from clsplat.options import SceneOptions
from clsplat.scene import View
from clsplat.training.parts.outlier_masks import Cells, resampled, spread

DEVICE_SHARE = 0.25  # of the device's memory that photos may take
IN_MEMORY_BYTES = 512 << 20  # of decoded photos that wait in host memory, not in a file
DISK_SHARE = 0.25  # of the free space of the disk that decoded photos may take
HOST_BYTES = 640 << 20  # of the photos that are decoded at the same time
BAND_COPIES = 8  # of a band: as the library has it, as 8-bit samples and as floats
LENS_BYTES = 14  # a pixel: the stored and the undistorted photo, and the map between them
MOST_THREADS = 8  # that read photos
HALF_THE_CORES = min(MOST_THREADS, (os.cpu_count() or 2) // 2)
THREADS = max(2, HALF_THE_CORES)  # while nothing else runs
THREADS_BESIDE = max(1, HALF_THE_CORES)  # beside a training
SMALL_SIDE = 256  # pixels of thumbnails; brightness, colours and depth need no more
Photo = NDArray[np.uint8]


def epoch_order(seed: int, epoch: int, visits: NDArray[np.floating]) -> NDArray[np.int64]:
    """The views of an epoch in their order, as many as there are views.

    Each comes as often as its share of all visits [V] says, rounded up or down at random (Madow
    1949, On the theory of systematic sampling).
    """
    rng, count = np.random.default_rng([seed, 1, epoch]), len(visits)
    order = rng.permutation(count)
    if (visits == visits[0]).all():
        return order
    ends = np.cumsum(visits[order])
    at = (np.arange(count) + rng.random()) * (ends[-1] / count)
    return rng.permutation(order[np.searchsorted(ends, at, side="right").clip(max=count - 1)])


def decode(view: View) -> Photo:
    """Read a view's photo at its camera's size: [3, H, W], or if pixels do not count [4, H, W] with
    a plane that is 0 there and 255 elsewhere."""
    planes, row = np.empty(photo_array(view).shape, np.uint8), 0
    for band in photo_bands(view):
        planes[:3, row : row + len(band)] = band.transpose(2, 0, 1)
        row += len(band)
    valid = read_valid(view)
    if valid is None and not view.weighed:
        return planes[:3]
    planes[3] = 255 if valid is None else np.uint8(255) * valid
    return planes


def decoded(views: Iterable[View]) -> Iterator[Photo]:
    """Yield `decode` of each view, from a few threads; InputError at a damaged photo."""
    views = list(views)
    most = _at_once(views, 2 * THREADS + 1, HOST_BYTES)
    yield from called_ahead(decode, zip(views), min(THREADS, most), most)


def _host_bytes(view: View) -> int:
    """About the most bytes of host memory that `decode` takes."""
    whole = LENS_BYTES * view.lens.width * view.lens.height if view.lens else 0
    return math.prod(photo_array(view).shape) + whole + BAND_COPIES * BAND_BYTES


def _at_once(views: Iterable[View], most: int, budget: int) -> int:
    """How many of these photos may be decoded at the same time: as many as fit, 1 to `most`."""
    return max(1, min(most, budget // max(map(_host_bytes, views), default=1)))


def reading_bytes(views: Sequence[View]) -> int:
    """The most bytes of host memory that photos take at a level, whatever their number; `views` are
    at the level with the largest photos."""
    held = max(math.prod(photo_array(view).shape) for view in views)
    return _at_once(views, 2 * THREADS + 1, HOST_BYTES) * max(map(_host_bytes, views)) + held


def size_note(views: Sequence[View], options: SceneOptions) -> str | None:
    """A message for the user if --max-resolution makes photos smaller than -r does, or None."""
    largest = max((view.camera for view in views), key=lambda camera: max(camera.width, camera.height))
    small = largest.reduced(options.downscale, options.max_resolution)
    if small.width == largest.reduced(options.downscale).width:
        return None
    return (
        f"photos of {largest.width}x{largest.height} are reduced to {small.width}x"
        f"{small.height}; --max-resolution none keeps their size"
    )


def at_level(views: Iterable[View], level: float) -> tuple[View, ...]:
    """The views with cameras of images `level` times smaller."""
    return tuple(replace(view, camera=view.camera.reduced(level)) for view in views)


def with_side(views: Sequence[View], side: float) -> tuple[View, ...]:
    """The views, all smaller by one factor where a photo's longer side has more than `side` pixels."""
    longest = max(max(view.camera.width, view.camera.height) for view in views)
    return at_level(views, max(1.0, longest / side))


def photo_array(view: View) -> ArraySpec:
    """The device array of a view's photo, with a mask if there may be one."""
    planes = 4 if view.may_have_mask or view.weighed else 3
    return ArraySpec((planes, view.camera.height, view.camera.width), np.uint8)


class Thumbnails:
    """Photos of at most SMALL_SIDE pixels, each decoded once for all that is decided from them."""

    def __init__(self, views: Sequence[View]) -> None:
        self.views = tuple(views)
        self._photos: dict[tuple[int, int, int], Photo] = {}

    def of(self, indices: Iterable[int]) -> tuple[tuple[View, ...], list[Photo]]:
        """Some of the views, with cameras that are smaller by one factor, and their photos as
        `decode` returns them."""
        indices = list(indices)
        small = with_side([self.views[index] for index in indices], SMALL_SIDE)
        keys = [(index, view.camera.width, view.camera.height) for index, view in zip(indices, small)]
        new = {key: view for key, view in zip(keys, small) if key not in self._photos}
        self._photos |= zip(new, decoded(new.values()))
        return small, [self._photos[key] for key in keys]

    def forget(self) -> None:
        """Drop all photos, to have their memory for other things."""
        self._photos.clear()

    def sampled(self, most: int) -> tuple[tuple[View, ...], list[Photo]]:
        """`of` at most so many evenly spaced views."""
        return self.of(range(0, len(self.views), -(-len(self.views) // most)))


class PhotoStore:
    """Decodes photos in threads, from the first to the last, and keeps them: all in host memory if
    they take no more than IN_MEMORY_BYTES, else in a file.

    The file has no name, so the system removes it however the process ends. Photos for which there
    is no space are decoded at each use: the first `count` are kept.

    `sizes` are the bytes of each photo, or more; `decode` returns one by its index, uint8[channels,
    H, W]; `folder` is that of the file, or None for the system's folder for temporary files.
    """

    def __init__(
        self, sizes: Sequence[int], decode: Callable[[int], Photo], threads: int, folder: Path | None = None
    ) -> None:
        ends, self._decode, self._lock = np.cumsum(sizes), decode, Lock()
        self._begins: list[int] = (ends - sizes).tolist()
        self._file: Any = None  # BytesIO, or what TemporaryFile is on this system
        try:
            if sum(sizes) <= IN_MEMORY_BYTES:  # some systems write a file to disk at its end
                self.count, self._file = len(sizes), BytesIO()
            else:
                folder = folder or Path(tempfile.gettempdir())
                self.count = int((ends <= DISK_SHARE * shutil.disk_usage(folder).free).sum())
                self._file = tempfile.TemporaryFile(dir=folder) if self.count else None
        except OSError:
            self.count = 0  # a folder that cannot be written
        self._threads = ThreadPoolExecutor(threads)
        self._shapes: list[Future[tuple[int, ...] | None]] = [
            self._threads.submit(self._keep, i) for i in range(self.count)
        ]

    def _keep(self, index: int) -> tuple[int, ...] | None:
        """Decode a photo into the store; returns its shape, or None if that cannot be written."""
        photo = self._decode(index)
        try:
            with self._lock:
                self._file.seek(self._begins[index])
                self._file.write(photo.data)
        except (OSError, MemoryError, ValueError):  # there is no space, or the store is closed
            return None
        return photo.shape

    def wait(self) -> None:
        """Wait until all photos that are kept are decoded; InputError at a damaged one."""
        for shape in self._shapes:
            shape.result()

    def read(self, index: int) -> Photo:
        """A photo, as `decode` returns it, once it is decoded; its errors."""
        shape = self._shapes[index].result() if index < self.count else None
        if shape is not None:
            photo = np.empty(shape, np.uint8)
            with self._lock:
                self._file.seek(self._begins[index])
                if self._file.readinto(photo.data) == photo.nbytes:
                    return photo
        return self._decode(index)

    def close(self) -> None:
        """Drop all photos, and remove the file."""
        self._threads.shutdown(wait=False, cancel_futures=True)
        self._shapes, self.count = [], 0
        with self._lock:
            if self._file is not None:
                self._file.close()


def _budget(device: Device) -> float:
    """The bytes that photos may take on a device."""
    return DEVICE_SHARE * device.memory_limit


def _photo_bytes(view: View) -> int:
    """Of a view's photo, on the device and in host memory."""
    return math.prod(photo_array(view).shape)


def _stored(views: Sequence[View], threads: int, budget: int, folder: Path | None) -> PhotoStore:
    return PhotoStore(
        list(map(_photo_bytes, views)), lambda index: decode(views[index]), _at_once(views, threads, budget), folder
    )


def begin_photos(device: Device, views: Sequence[View], level: float, folder: Path) -> PhotoStore:
    """Begin to decode the photos of a training's first level for `Photos`: where they will stay on
    the device, the first ones, as many as may wait in host memory, else all."""
    views = at_level(views, level)
    ends = np.cumsum(list(map(_photo_bytes, views)))
    if ends[-1] <= _budget(device):
        views = views[: int((ends <= IN_MEMORY_BYTES).sum())]
    return _stored(views, THREADS, HOST_BYTES // 2, folder)


def begin_checks(views: Sequence[View]) -> PhotoStore:
    """Begin to decode photos of which nothing is kept: `wait` raises InputError at a damaged one."""
    return PhotoStore(
        [0] * len(views), lambda index: decode(views[index])[:0], _at_once(views, THREADS, HOST_BYTES // 2)
    )


class Photos:
    """`photos[i]` is view i's photo at the present level on the device, as `decode` returns it.

    The photos of a level that fits the budget are read once and stay on the device. Those of other
    levels are decoded into a `PhotoStore` and read from it, one ahead: `expect` announces the
    next. While a level is trained, the photos of the next are decoded into a store of their own.
    All photos are decoded at the start, so that a damaged one is refused before a run begins;
    `begun` is a level and the store into which these are decoded already (`begin_photos`).

    `views` have cameras of the size of level 1; `levels` are down-sampling factors in the order in
    which they will come, from `level`, or for 0 from the first. `budget_bytes` is the limit for
    photos on the device; None: DEVICE_SHARE of its memory. `folder` is that of a `PhotoStore`. The
    attributes `level` and `views` are those at present, `resident` is whether these photos stay on
    the device, and `read_seconds` is the duration of the last change of level.
    """

    def __init__(
        self,
        device: Device,
        views: Sequence[View],
        levels: Sequence[float] = (1.0,),
        budget_bytes: int | None = None,
        folder: Path | None = None,
        level: float = 0.0,
        begun: tuple[float, PhotoStore] | None = None,
    ) -> None:
        self.device, self._full, self._levels, self.folder = device, views, levels, folder
        self._budget = _budget(device) if budget_bytes is None else budget_bytes
        self._threads = ThreadPoolExecutor(1)
        self._ahead: dict[int, Future[Photo]] = {}
        # level -> its photos: of this level, if it is not resident, and of the next
        self._stores: dict[float, PhotoStore] = dict([begun] if begun else [])
        self.level = 0.0  # none yet
        # of views that are `weighed`, the cells whose pixels are left out besides those that do not
        # count anyway (parts/outlier_masks.py); None: none were looked for yet
        self.ignored: list[Cells] | None = None
        self.use(level or levels[0])

    def use(self, level: float) -> None:
        """Change the level, and begin to read the next one."""
        if level == self.level:
            return
        begin = time.perf_counter()
        first, self.level, self.views = not self.level, level, at_level(self._full, level)
        self.resident = sum(map(_photo_bytes, self.views)) <= self._budget
        for pending in self._ahead.values():
            pending.cancel()
        self._ahead.clear()
        store = self._stores.pop(level, None)
        self._close_stores()
        self._arrays: list[Array] = []
        if self.resident:
            kept = store.count if store else 0
            photos = chain(map(store.read, range(kept)) if store else (), decoded(self.views[kept:]))
            self._arrays = [self.device.upload(photo) for photo in photos]
            if store:
                store.close()
        else:
            store = store or _stored(self.views, THREADS, HOST_BYTES, self.folder)
            if first:
                store.wait()
                for _ in decoded(self.views[store.count :]):
                    pass
            self._stores[level] = store
        if self.ignored is not None:
            self.ignore(
                [
                    resampled(cells, view.camera.height, view.camera.width)
                    for cells, view in zip(self.ignored, self.views)
                ]
            )
        self.read_seconds = time.perf_counter() - begin
        for following in [new for new in self._levels if new < level][:1]:
            self._stores[following] = _stored(
                at_level(self._full, following), THREADS_BESIDE, HOST_BYTES // 2, self.folder
            )

    def _close_stores(self) -> None:
        for store in self._stores.values():
            store.close()
        self._stores.clear()

    def expect(self, index: int) -> None:
        """Begin to read a photo that will be used soon."""
        if index not in self._ahead and (store := self._stores.get(self.level)):
            self._ahead[index] = self._threads.submit(store.read, index)

    def __getitem__(self, index: int) -> Array:
        if self.resident:
            return self._arrays[index]
        pending = self._ahead.pop(index, None)
        photo = pending.result() if pending else self._stores[self.level].read(index)
        if self.ignored is not None:
            _leave_out(photo[3], self.ignored[index])
        return self.device.upload(photo)

    def ignore(self, cells: list[Cells]) -> None:
        """Leave out the pixels of these cells of each view from now on, and no others."""
        self.ignored = cells
        for array, view, ignored in zip(self._arrays, self.views, cells):
            mask = _own_mask(view)
            _leave_out(mask, ignored)
            array.write(mask[None], 3)

    def unweighed(self, index: int) -> Photo:
        """A view's photo as `decode` returns it, where pixels are left out by its own mask only."""
        if not self.resident:
            return self._stores[self.level].read(index)
        photo: Photo = self._arrays[index].download()
        photo[3] = _own_mask(self.views[index])
        return photo

    def close(self) -> None:
        """Stop reading ahead, and remove the files."""
        self._threads.shutdown(wait=False, cancel_futures=True)
        self._close_stores()


def _own_mask(view: View) -> Photo:
    """The last plane of `decode` of a view that is `weighed`."""
    valid = read_valid(view)
    if valid is None:
        valid = np.ones((view.camera.height, view.camera.width), bool)
    return valid * np.uint8(255)


def _leave_out(mask: Photo, ignored: Cells) -> None:
    mask[spread(ignored, *mask.shape)] = 0
