"""The gaussians in training: rows on the device, and the Adam moments aligned with them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from clsplat.densify.grow import Growth
from clsplat.device import Array, ArraySpec, Device, Reading, pinned
from clsplat.errors import OutOfDeviceMemory, TooFewPages
from clsplat.gaussians import FIELDS, LEARNED, Gaussians
from clsplat.optimise.adam import MOMENTS_OF_REST, CodedAdam, DeviceAdam
from clsplat.optimise.numpy_adam import NumpyAdam
from clsplat.optimise.page_store import PageStore
from clsplat.optimise.pages import Pages
from clsplat.options import ScheduledOptions
from clsplat.primitives.compact import compact, new_counts
from clsplat.primitives.gather import CHUNK_ROWS, download_rows, gather, scatter
from clsplat.primitives.reduce import add_to

# of the device's memory; beyond it, moments are coded, and beyond that harmonics are paged: frames
# take as much again and photos a quarter
DEVICE_SHARE = 1 / 3
# of the device's memory that pages leave free: for frames, and once frames have theirs
FRAME_SHARE, SPARE_SHARE = 0.2, 0.03
GIVEN_SHARE = 0.04  # of the device's memory that pages give back at a time
FORESEEN = 64  # samples, of which it is known which pages they want
FORESEEN_AT_ONCE = 4  # new ones of them in a step
MARGIN = 1.0  # pixels beside an image of which pages are wanted, too
Adam = DeviceAdam | NumpyAdam
Result = TypeVar("Result")
Upcoming = Callable[[int], tuple[int, Array]]  # number of a sample -> its view and packed camera
ENGINES: dict[str, type[Adam]] = {"device": DeviceAdam, "coded": CodedAdam, "numpy": NumpyAdam}


class Model:
    """Rows of gaussians on the device, and an Adam engine whose moments follow them.

    The moments are kept by `engine` "device", "coded" or "numpy". Where the device has no memory
    for all of them, the harmonics above the constant and their moments are in `pages`, of which the
    `folder` has the file if they fit no memory.
    `layout` is another object after each change of the number of gaussians.
    """

    def __init__(
        self, device: Device, gaussians: Gaussians, engine: str = "device", folder: Path | None = None
    ) -> None:
        self._folder = folder
        self.device, self.sh_degree = device, gaussians.sh_degree
        self.frozen: Array | None = None  # uint[count], not 0 for those that are not trained
        self.count, self.layout = gaussians.count, object()
        self.pages: Pages | None = None
        self._engine, self._spare = engine, FRAME_SHARE
        self._asked: dict[int, Reading] = {}  # number of a sample -> the pages that it will want
        self._wants: dict[int, NDArray[np.uint8]] = {}  # view -> bits, the pages that it wanted
        # the same, not read yet: number of the sample at which that is done, and the view
        self._foreseen: deque[tuple[int, int, Reading]] = deque()
        kind, fields = ENGINES[engine], dict(gaussians.rows)
        needed = model_bytes(device, self.sh_degree, self.count, engine)
        if (
            issubclass(kind, DeviceAdam)
            and gaussians.sh_degree
            and (needed > self._free_bytes() or not self._fits_buffer(self.count))
        ):
            rest = fields.pop("sh_rest")
            self.pages = self._make_pages(
                gaussians.positions,
                rest,
                {
                    name: np.zeros((self.count, rest[0].size), dtype or device.real)
                    for name, dtype in zip(MOMENTS_OF_REST, kind.STORED.dtypes)
                },
            )
        self._arrays = {name: device.upload(values) for name, values in fields.items()}
        self.adam: Adam = (
            kind(device, self.learned, self.pages) if issubclass(kind, DeviceAdam) else kind(device, self.learned)
        )

    def _make_pages(
        self, positions: NDArray[np.floating], sh_rest: NDArray[np.floating], moments: dict[str, NDArray[Any]]
    ) -> Pages:
        store = PageStore(
            positions,
            {"sh_rest": sh_rest.astype(self.device.real), **moments},
            self._folder,
            lambda words: pinned(self.device, (words,)),
        )
        return Pages(self.device, store, self._free_bytes)

    def _free_bytes(self) -> int:
        """Bytes that arrays of the model may take, so that frames find room."""
        return int((1 - self._spare) * self.device.memory_limit) - self.device.memory_bytes

    def _fits_buffer(self, count: int) -> bool:
        """Whether all harmonics fit one buffer."""
        spec = self.arrays(["sh_rest"], self.sh_degree, count)["sh_rest"]
        return spec.nbytes(self.device.real) <= self.device.largest_buffer

    @staticmethod
    def arrays(names: Iterable[str], sh_degree: int, count: int) -> dict[str, ArraySpec]:
        """The device arrays of the named fields."""
        shapes = {field.name: field.row_shape(sh_degree) for field in FIELDS}
        return {name: ArraySpec((count, *shapes[name])) for name in names}

    @property
    def rows(self) -> dict[str, Array]:
        """Field name -> real[count, *row shape], the arrays of the model; if harmonics are paged,
        also `places` and `slots` (cl/include/rest.h), and `sh_rest` are the pages that are there.

        Gaussians that no view saw may lag behind the last step (`catch_up`, `seen`).
        """
        if self.pages is None:
            return dict(self._arrays)
        return {
            **self._arrays,
            "sh_rest": self.pages.arrays["sh_rest"],
            "places": self.pages.places,
            "slots": self.pages.slots,
        }

    @property
    def memory(self) -> object:
        """Another object after each change of the arrays."""
        return self.pages.layout if self.pages else self.layout

    @property
    def learned(self) -> dict[str, Array]:
        """The rows without those that Adam does not move."""
        fixed = {field.name for field in FIELDS} - {field.name for field in LEARNED}
        return {name: array for name, array in self.rows.items() if name not in fixed}

    def catch_up(self) -> None:
        """Bring all gaussians up to the last step.

        This rounds, so when it is done must follow from the options alone.
        """
        self.adam.catch_up(self.learned, self.frozen)

    # --- copies, for whoever looks at the model at any time

    def seen(self, camera: Array) -> dict[str, Array]:
        """The learned rows that a packed camera, real[27], may see, as they are after the last
        step, in their order; all rows, if none lags and all are on the device. Waits."""
        if isinstance(self.adam, NumpyAdam) or self.adam.is_current and not self.pages:
            return self.learned
        flags = self.adam.seen(self.rows, camera, self.adam.steps, MARGIN)
        if self.pages and self.pages.bring(wanted := self.pages.mark(flags).download() > 0):
            if self.adam.is_current:
                return self.learned
            wanted[:] = False
        chosen = compact(self.device, flags, new_counts(self.device))
        if not self.pages or not wanted.any():
            return self.adam.current(self.learned, chosen, self.frozen)
        found = {
            name: self.device.empty((len(chosen), *array.shape[1:]))
            for name, array in self.learned.items()
            if name not in ("places", "slots")
        }
        for index, rows in self.pages.rounds_of(chosen.download()):
            current = self.adam.current(self.learned, self.device.upload(rows), self.frozen)
            for name, array in current.items():
                scatter(self.device, array, self.device.upload(index), found[name])
        return found

    def download(self) -> Gaussians:
        """Copy the rows to the host, as they are after the last step."""
        return self.within(self._download)

    def _download(self) -> Gaussians:
        rows = self.stored()
        if not (isinstance(self.adam, NumpyAdam) or self.adam.is_current):
            for chosen in self._chunks():
                current = self.adam.current(self.learned, self.device.upload(chosen), self.frozen)
                for name, array in current.items():
                    rows[name][chosen] = array.download()
        return Gaussians(
            {name: rows[name] for name in (field.name for field in FIELDS) if name in rows}, self.sh_degree
        )

    def _chunks(self) -> Iterator[NDArray[np.uint32]]:
        """All rows, some at a time, of which the harmonics are on the device then."""
        if self.pages:
            for pages in self.pages.rounds(CHUNK_ROWS):
                yield self.pages.store.rows_of(pages)
            return
        for first in range(0, self.count, CHUNK_ROWS):
            yield np.arange(first, min(first + CHUNK_ROWS, self.count), dtype=np.uint32)

    def stored(self, rows: NDArray[np.integer] | None = None) -> dict[str, NDArray[Any]]:
        """Copy rows, int[K], or all if that is None, to the host as they are stored, by field."""
        return {name: self.field(name, rows) for name in (*self._arrays, "sh_rest")}

    def field(self, name: str, rows: NDArray[np.integer] | None = None) -> NDArray[Any]:
        """A field of rows, int[K], or of all if that is None, as it is stored."""
        if name == "sh_rest" and self.pages:
            return self.pages.download(name)[slice(None) if rows is None else rows]
        return download_rows(self.device, self._arrays[name], rows)

    def add_to(self, name: str, total: Array | NDArray[Any] | None) -> Array | NDArray[Any]:
        """Add a field to a sum of earlier ones, on the device, or on the host if harmonics are
        paged; None: the sum begins."""
        if isinstance(total, Array) and self.pages:  # harmonics were not paged before
            total = total.download()
        if total is None:
            return self.field(name) if self.pages else self.within(self._arrays[name].copied)
        if isinstance(total, Array):
            add_to(self.device, total, self._arrays[name])
        elif name == "sh_rest" and self.pages:
            self.pages.add_to(name, total)
        else:
            total += self.field(name)
        return total

    def within(self, work: Callable[[], Result]) -> Result:
        """Do work that changes nothing, again and again while the model has memory to give back."""
        while True:
            try:
                return work()
            except OutOfDeviceMemory as error:
                if isinstance(error, TooFewPages) or not self.is_bounded:
                    raise
            self.give_back()  # now that no exception keeps arrays alive

    def write(self, name: str, values: NDArray[np.floating], first: int = 0) -> None:
        """Overwrite rows of a field from row `first` on."""
        if name == "sh_rest" and self.pages:
            self.pages.write(name, values.astype(self.device.real), first)
        else:
            self._arrays[name].write(values, first)

    # --- changes of the rows

    def regrow(self, growth: Growth) -> None:
        """Replace the rows as a round of growth requires; new rows have no moments.

        All rows are copied, field by field, into arrays of the new size: room for later rounds
        would save no copy.
        """
        self.catch_up()
        self._asked.clear()
        self._wants.clear()
        self._foreseen.clear()
        old, self.count, self.layout = self.count, len(growth.source), object()
        self._spare = FRAME_SHARE
        self.device.trim()  # frames of another number of gaussians need other sizes
        if self.pages:
            self.pages.leave()
        elif self._can_be_paged() and (
            self._regrown_bytes(old) > self._free_bytes() or not self._fits_buffer(self.count)
        ):
            self._use_pages()
        source = self.device.upload(growth.source)
        for name, array in self._arrays.items():
            new = self.device.allocate((self.count, *array.shape[1:]))
            self._arrays[name] = gather(self.device, array, source, new)
        self.adam.regrow(source, growth.kept)
        changes = dict(growth.changes)
        rest = changes.pop("sh_rest", None) if self.pages else None
        for name, (first, values) in changes.items():
            self.write(name, values, first)
        if self.pages:
            positions = self._arrays["positions"].download()
            self.pages.regrow(growth.source, growth.kept, positions, "sh_rest")
            if rest:
                self.write("sh_rest", rest[1], rest[0])

    def limit_opacity(self, logit: float) -> None:
        """Limit opacity logits, of the gaussians that are trained, and reset the moments of all
        opacities (Kerbl et al. 2023)."""
        self.catch_up()
        logits = self.rows["opacity_logits"]
        values, trained = logits.download(), self.frozen is None or self.frozen.download() == 0
        logits.write(np.minimum(values, logit, out=values, where=trained))
        self.adam.reset("opacity_logits")

    # --- pages

    def _can_be_paged(self) -> bool:
        return isinstance(self.adam, DeviceAdam) and self.sh_degree > 0

    def _regrown_bytes(self, old: int) -> int:
        """How many bytes more are in use while rows are copied, the largest array twice."""
        before, now = (model_bytes(self.device, self.sh_degree, count, self._engine) for count in (old, self.count))
        return max(now - before, 0) + self._arrays["sh_rest"].nbytes

    def _use_pages(self) -> None:
        """Take the harmonics and their moments from the device to pages."""
        assert isinstance(self.adam, DeviceAdam)
        rest, positions = self._arrays.pop("sh_rest").download(), self._arrays["positions"]
        self.adam.use_pages(lambda moments: self._make_pages(positions.download(), rest, moments))
        self.pages = self.adam.pages

    def forget_asked(self) -> None:
        """Ask anew which pages samples want."""
        self._asked.clear()

    @property
    def is_bounded(self) -> bool:
        """Whether memory may lack that the model can give back."""
        return self.pages is not None or (
            self.device.memory_limit < self.device.handle.global_mem_size and self._can_be_paged()
        )

    def give_back(self) -> None:
        """Give back memory of the device; OutOfDeviceMemory where there is none left."""
        self._asked.clear()
        self.device.trim()
        if self.pages is None:
            self._use_pages()
        else:
            self.pages.shrink(int(GIVEN_SHARE * self.device.memory_limit))

    def fill_memory(self) -> bool:
        """Let pages take what frames have left of the memory; whether they are on the host for
        that, until the next `fetch`."""
        self._spare = SPARE_SHARE
        return self.pages is not None and self.pages.leave_for_more()

    def look_ahead(self, number: int, steps: int, upcoming: Upcoming, numbers: Mapping[str, float]) -> None:
        """Ask which pages a sample will want so many steps later; `numbers` are those of Adam."""
        if not (self.pages and self.pages.room and isinstance(self.adam, DeviceAdam)):
            return
        ahead = steps * numbers["rate_positions"], steps * numbers["rate_log_scales"]
        self._asked[number] = Reading(self._wanted(upcoming(number)[1], ahead))
        asked = {view for _, view, _ in self._foreseen}
        unknown = {
            view: camera
            for view, camera in map(upcoming, range(number + 1, number + FORESEEN))
            if view not in self._wants and view not in asked
        }
        for view, camera in [*unknown.items()][:FORESEEN_AT_ONCE]:
            self._foreseen.append((number, view, Reading(self._wanted(camera, ahead))))

    def fetch(self, numbers: Sequence[int], degree: int, upcoming: Upcoming) -> None:
        """Bring the pages that the samples of a step want."""
        if self.pages and degree:
            for number in [asked for asked in self._asked if asked < numbers[0]]:
                del self._asked[number]

            while self._foreseen and self._foreseen[0][0] <= numbers[0]:  # the device is there
                _, view, reading = self._foreseen.popleft()
                self._wants.setdefault(view, np.packbits(reading.values() > 0))

            def next_use() -> NDArray[np.int64]:
                return self._next_use(numbers[-1], upcoming)

            wanted = self._wanted_by(numbers, upcoming)
            if not self.pages.bring(wanted, next_use):
                self._asked.clear()  # perhaps they want less by now
                self._spare = SPARE_SHARE
                self.pages.fetch(self._wanted_by(numbers, upcoming), next_use)
            self.pages.note_change()

    def _wanted_by(self, numbers: Sequence[int], upcoming: Upcoming) -> NDArray[np.bool_]:
        """The pages that samples want: as it was asked before, or else as it is now."""
        found = []
        for number in numbers:
            view, camera = upcoming(number)
            asked = self._asked.get(number)
            found.append((asked.values() if asked else self._wanted(camera).download()) > 0)
            self._wants[view] = np.packbits(found[-1])
        every: NDArray[np.bool_] = np.logical_or.reduce(found)
        return every

    def _next_use(self, number: int, upcoming: Upcoming) -> NDArray[np.int64]:
        """How many samples after this one a page will be wanted again, if all is as it was when its
        view was trained on last."""
        assert self.pages
        found = np.full(self.pages.pages, FORESEEN + 1)
        for later in range(FORESEEN, 0, -1):
            wants = self._wants.get(upcoming(number + later)[0])
            if wants is not None:
                found[np.unpackbits(wants, count=len(found)).view(bool)] = later
        return found

    def _wanted(self, camera: Array, ahead: tuple[float, float] = (0.0, 0.0)) -> Array:
        """uint[pages], 1 for those of which a camera may see a row; `ahead` as for `seen` of Adam."""
        assert self.pages and isinstance(self.adam, DeviceAdam)
        return self.pages.mark(self.adam.seen(self.rows, camera, self.adam.steps, MARGIN, ahead))

    def require_seen(self, camera: Array, numbers: Mapping[str, float], degree: int, counts: Array, ends: bool) -> None:
        """Let the frame of `counts` fail where a page that it wants is not there; `numbers` are
        those of Adam for this step, of which this is the last frame if it `ends`."""
        if self.pages and degree and isinstance(self.adam, DeviceAdam):
            flags = self.adam.seen(self.rows, camera, numbers["before"], MARGIN)
            self.pages.require(flags, counts, ends)


def model_bytes(device: Device, sh_degree: int, count: int, engine: str) -> int:
    """Bytes of parameters and moments on a device, with an engine of ENGINES."""
    rows = Model.arrays([field.name for field in LEARNED], sh_degree, count)
    return sum(spec.nbytes(device.real) for specs in (rows, *ENGINES[engine].arrays(rows)) for spec in specs.values())


def is_pageable(options: ScheduledOptions) -> bool:
    """Whether harmonics of a training can be paged."""
    return options.sh_degree > 0 and issubclass(ENGINES[options.engine], DeviceAdam)


def paged_arrays(options: ScheduledOptions, count: int) -> list[ArraySpec]:
    """What is in pages where it is paged: harmonics above the constant and their two moments."""
    rows = Model.arrays([field.name for field in LEARNED], options.sh_degree, count)
    m, v, _ = ENGINES[options.engine].arrays(rows)
    return [rows["sh_rest"], m["rest"], v["rest"]]


def checkpoint_bytes(count: int, sh_degree: int) -> int:
    """Approximate size in bytes of checkpoint and finished model, of `count` gaussians."""
    floats = sum(field.width(sh_degree) for field in LEARNED)
    return 4 * 4 * floats * count  # parameters, two moments, and the PLY file
