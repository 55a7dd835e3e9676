"""Training photos at each level, which stay on the device while they fit."""

import functools
import os
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from clsplat.device import Array, ArraySpec, Device
from clsplat.io.views import read_photo
from clsplat.options import TrainOptions
from clsplat.scene import View
from clsplat.training.robust import Cells, resampled, spread

DEVICE_SHARE = 0.25  # of the device's memory that photos may take
MOST_THREADS = 8  # that read photos; each needs memory for a part of one as floats
HALF_THE_CORES = min(MOST_THREADS, (os.cpu_count() or 2) // 2)
THREADS = max(2, HALF_THE_CORES)  # while nothing else runs
THREADS_BESIDE = max(1, HALF_THE_CORES)  # beside a training


@functools.lru_cache(maxsize=2)  # the epoch of this step and of the next
def epoch_order(seed: int, epoch: int, count: int) -> NDArray[np.int64]:
    """The order of the views in an epoch, [count]."""
    return np.random.default_rng([seed, 1, epoch]).permutation(count)


def decode(view: View) -> NDArray[np.uint8]:
    """Read a view's photo at its camera's size: [3, H, W], or if pixels do not count [4, H, W] with
    a plane that is 0 there and 255 elsewhere."""
    planes, valid = read_photo(view).transpose(2, 0, 1), view.valid()
    if valid is None and view.weighed:
        valid = np.ones(planes.shape[1:], bool)
    if valid is not None:
        planes = np.concatenate([planes, valid[None] * np.uint8(255)])
    return np.ascontiguousarray(planes)


def decoded(views: Iterable[View]) -> Iterator[NDArray[np.uint8]]:
    """Yield `decode` of each view, from a few threads; InputError at a damaged photo."""
    with ThreadPoolExecutor(THREADS) as threads:
        ahead: deque[Future[NDArray[np.uint8]]] = deque()  # kept short: photos are large
        for view in views:
            ahead.append(threads.submit(decode, view))
            if len(ahead) > 2 * THREADS:
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()


def size_note(views: Sequence[View], options: TrainOptions) -> str | None:
    """A message for the user if --max-resolution makes photos smaller, or None.

    A reduction by -r is not mentioned.

    Parameters
    ----------
    views : as they were read.
    options : of the training.
    """
    limited = [view.camera for view in views
               if view.camera.reduced(options.downscale, options.max_resolution).width
               < view.camera.reduced(options.downscale).width]
    if not limited:
        return None
    largest = max(limited, key=lambda camera: camera.width * camera.height)
    small = largest.reduced(options.downscale, options.max_resolution)
    return (f"photos of {largest.width}x{largest.height} are reduced to {small.width}x"
            f"{small.height}; --max-resolution none keeps their size")


def at_level(views: Iterable[View], level: float) -> tuple[View, ...]:
    """The views with cameras of images `level` times smaller."""
    return tuple(replace(view, camera=view.camera.reduced(level)) for view in views)


def photo_array(view: View) -> ArraySpec:
    """The device array of a view's photo, with a mask if there may be one."""
    planes = 4 if view.may_have_mask or view.weighed else 3
    return ArraySpec((planes, view.camera.height, view.camera.width), np.uint8)


class Photos:
    """`photos[i]` is view i's photo at the present level on the device, as `decode` returns it.

    The photos of a level that fits the budget are resampled once; a thread reads them while the
    previous level is trained. At other levels each photo is decoded again at each use, one ahead:
    `expect` announces the next. All photos are decoded at the start, so that a damaged one is
    refused before a run begins.

    Parameters
    ----------
    device : of the photos.
    views : with cameras of the size of level 1.
    levels : down-sampling factors in the order in which they will come.
    budget_bytes : limit for photos on the device; None: DEVICE_SHARE of its memory.

    Attributes
    ----------
    level, views : the present level, and the views at it.
    resident : whether the photos of this level stay on the device.
    ignored : of views that are `weighed`, the cells whose pixels are left out besides those that do
        not count anyway (robust.py); None: none were looked for yet.
    read_seconds : duration of the last change of level.
    """

    def __init__(self, device: Device, views: Sequence[View], levels: Sequence[float] = (1.0,),
                 budget_bytes: int | None = None) -> None:
        self.device, self._full, self._levels = device, views, levels
        self._budget = (DEVICE_SHARE * device.handle.global_mem_size if budget_bytes is None
                        else budget_bytes)
        self._threads = ThreadPoolExecutor(THREADS_BESIDE)
        self._ahead: dict[int, Future[NDArray[np.uint8]]] = {}
        # (level, its photos)
        self._next: tuple[float, list[Future[NDArray[np.uint8]]]] | None = None
        self.level = 0.0  # none yet
        self.ignored: list[Cells] | None = None
        if not self._fits(at_level(views, levels[0])):
            for _ in decoded(views):
                pass
        self.use(levels[0])

    def use(self, level: float) -> None:
        """Change the level, and begin to read the next one."""
        if level == self.level:
            return
        begin = time.perf_counter()
        self.level, self.views = level, at_level(self._full, level)
        self.resident = self._fits(self.views)
        self._ahead.clear()
        self._arrays: list[Array] = []
        if self.resident:
            expected, self._next = self._next, None
            photos = ((future.result() for future in expected[1])
                      if expected and expected[0] == level else decoded(self.views))
            self._arrays = [self.device.upload(photo) for photo in photos]
        if self.ignored is not None:
            self.ignore([resampled(cells, view.camera.height, view.camera.width)
                         for cells, view in zip(self.ignored, self.views)])
        self.read_seconds = time.perf_counter() - begin
        following = [new for new in self._levels if new < level]
        if following and self._fits(at_level(self._full, following[0])):
            self._next = following[0], [self._threads.submit(decode, view)
                                        for view in at_level(self._full, following[0])]

    def _fits(self, views: Iterable[View]) -> bool:
        return _nbytes(self.device, views) <= self._budget

    @property
    def spare_bytes(self) -> float:
        """What is left of the budget beside the photos of this level; 0 if they do not fit."""
        return max(0.0, self._budget - _nbytes(self.device, self.views))

    def expect(self, index: int) -> None:
        """Begin to decode a photo that will be used soon."""
        if not self.resident and index not in self._ahead:
            self._ahead[index] = self._threads.submit(decode, self.views[index])

    def __getitem__(self, index: int) -> Array:
        if self.resident:
            return self._arrays[index]
        pending = self._ahead.pop(index, None)
        photo = pending.result() if pending else decode(self.views[index])
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

    def unweighed(self, index: int) -> NDArray[np.uint8]:
        """A view's photo as `decode` returns it, where pixels are left out by its own mask only."""
        if not self.resident:
            return decode(self.views[index])
        photo: NDArray[np.uint8] = self._arrays[index].download()
        photo[3] = _own_mask(self.views[index])
        return photo

    def close(self) -> None:
        """Stop reading ahead."""
        self._threads.shutdown(wait=False, cancel_futures=True)


def _own_mask(view: View) -> NDArray[np.uint8]:
    """The last plane of `decode` of a view that is `weighed`."""
    valid = view.valid()
    if valid is None:
        valid = np.ones((view.camera.height, view.camera.width), bool)
    return valid * np.uint8(255)


def _leave_out(mask: NDArray[np.uint8], ignored: Cells) -> None:
    mask[spread(ignored, *mask.shape)] = 0


def _nbytes(device: Device, views: Iterable[View]) -> int:
    """Bytes of the photos of views on a device."""
    return sum(photo_array(view).nbytes(device.real) for view in views)
