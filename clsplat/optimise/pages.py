"""Pages of harmonics and their moments, for models larger than the device (cl/pages.cl).

Three quarters of a gaussian are its harmonics above the constant and their moments, and only a view
that sees it needs them. Rows that are near each other in space share a page of PAGE_ROWS. All pages
are in host memory, or in a file where that is too small; those that views see now have a slot on
the device. What is computed does not depend on which these are: a frame that wants a page without a
slot fails, and is repeated once the page is there (units.py).
"""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import FRAME_COUNTS, PAGE_ROWS
from clsplat.device import Array, ArraySpec, Device, Kernel, Transfers, Writing, each, pinned
from clsplat.errors import InputError, OutOfDeviceMemory, TooFewPages, reason

ABSENT = 1 << 31  # as in cl/include/rest.h
QUAD = 16  # bytes that a work-item copies
STAGED_BYTES = 32 << 20  # of pages that are on their way together
TURNS = 8  # groups of pages that are on their way at the same time
HOST_SHARE = 0.5  # of the host's memory that pages may take
THREADS = min(8, os.cpu_count() or 1)  # that copy pages in host memory
BITS = 10  # of each coordinate in the order of pages
PAGED = (("PAGED", 1),)

MARK = Kernel("pages.cl", "mark_pages", each("count"), count="uint", flags=("uint", "N"),
              places=("uint", "N"), wanted=("uint", "Q"))
REQUIRE = Kernel("pages.cl", "require_pages", each("pages"), pages="uint", clears="uint",
                 slots=("uint", "Q"), wanted=("uint", "Q"), counts=("uint", FRAME_COUNTS))
COPY = Kernel("pages.cl", "copy_pages", each("count quads"), count="uint", quads="uint",
              brings="uint", list=("uint", "L"), slots=("uint", "P", "W"),
              staged=("uint", "G", "W"))
REST_ROWS = Kernel("pages.cl", "rest_rows", each("count"), count="uint", rows=("uint", "C"),
                   places=("uint", "N"), slots=("uint", "Q"), lies=("uint", "C"))


class _Transit:
    """Memory in which a group of pages travels.

    Attributes
    ----------
    staged : by name of an array, uint[most, words of a page], on the device.
    host : the same in host memory.
    list, slots : uint[most], the slots from or to which they travel, on the device and the host.
    pages : int[], those that are on their way to the host.
    travelled : what the host waits for before it uses this memory again.
    used : the end of the last kernel that used this memory.
    """

    def __init__(self, device: Device, words: Mapping[str, int], most: int) -> None:
        self.staged = {name: device.allocate((most, each), np.uint32)
                       for name, each in words.items()}
        self.host = {name: pinned(device, (most, each)) for name, each in words.items()}
        self.list = device.allocate(most, np.uint32)
        self.slots = pinned(device, (most,))
        self.pages = np.zeros(0, np.int64)
        self.travelled: list[Any] = []
        self.used: Any = None


@dataclass(eq=False)
class _Table:
    """A copy of `Pages.slots` in host memory, and its way to the device."""

    host: NDArray[np.uint32]
    writing: Writing | None = None


class Pages:
    """Rows of some arrays in pages.

    Parameters
    ----------
    positions : float[N, 3], by which rows are put in pages.
    values : name of an array -> [N, *row shape], whose values are copied.
    free : returns how many bytes of device memory pages may take now.
    folder : of the file of what host memory cannot hold; None: that of temporary files.

    Attributes
    ----------
    arrays : name -> [slots * PAGE_ROWS, *row shape], the pages on the device.
    places : uint[N], the place of a row in the order of all pages.
    slots : uint[pages], where a page is (cl/include/rest.h).
    room : the number of slots; 0: there is no memory on the device.
    layout : another object after each change of the arrays.
    """

    def __init__(self, device: Device, positions: NDArray[np.floating],
                 values: Mapping[str, NDArray[Any]], free: Callable[[], int],
                 folder: Path | None = None) -> None:
        self.device, self._free, self._folder = device, free, folder
        self._threads, self._transfers = ThreadPoolExecutor(THREADS), Transfers(device)
        self._specs = {name: ArraySpec(of_rows.shape[1:], of_rows.dtype)
                       for name, of_rows in values.items()}
        self._words = {name: PAGE_ROWS * spec.nbytes(device.real) // 4
                       for name, spec in self._specs.items()}
        self._arrange(positions)
        self._stores = {name: self._new_store(name) for name in values}
        for name, of_rows in values.items():
            self._fill(name, of_rows, self._order)
        self._make_slots(0)

    # --- the order of rows, and the pages in host memory

    def _arrange(self, positions: NDArray[np.floating]) -> None:
        """Put rows into pages."""
        self.count, self.pages = len(positions), max(1, -(-len(positions) // PAGE_ROWS))
        self._most = self.pages  # slots, as far as is known
        self._order = spatial_order(positions)
        self._place = np.empty(self.count, np.uint32)
        self._place[self._order] = np.arange(self.count, dtype=np.uint32)
        self.places = self.device.upload(self._place)
        self.slots = self.device.allocate(self.pages, np.uint32)
        self._wanted = self.device.zeros(self.pages, np.uint32)  # by frames under way

    def _new_store(self, name: str) -> NDArray[np.uint32]:
        """Zeros for all pages of an array; in a file without a name where the host has too little
        memory for all arrays."""
        shape, needed = (self.pages, self._words[name]), self.pages * self.page_bytes
        if needed <= HOST_SHARE * host_memory():
            return np.zeros(shape, np.uint32)
        folder = self._folder or Path(tempfile.gettempdir())
        nbytes = 4 * math.prod(shape)
        try:
            with tempfile.TemporaryFile(dir=folder) as file:
                if hasattr(os, "posix_fallocate"):  # or a full disk would end the process later
                    os.posix_fallocate(file.fileno(), 0, nbytes)
                    return np.memmap(file, np.uint32, "r+", shape=shape)
                return np.memmap(file, np.uint32, "w+", shape=shape)
        except OSError as error:
            raise InputError(
                f"{folder}: no room for {nbytes >> 20:,} MiB of gaussians that fit neither the "
                f"device nor the host's memory ({reason(error)}); free some, or use "
                "--max-gaussians") from None

    def _rows_of(self, name: str) -> NDArray[Any]:
        """[pages * PAGE_ROWS, *row shape], a store by places."""
        shape, dtype = self._specs[name]
        rows: NDArray[Any] = self._stores[name].reshape(-1).view(np.dtype(dtype))
        return rows.reshape(-1, *shape)

    def _fill(self, name: str, source: NDArray[Any], rows: NDArray[np.uint32]) -> None:
        """Put these rows of an array at the places of a store, in threads."""
        store = self._rows_of(name)

        def fill(page: int) -> None:
            places = slice(page * PAGE_ROWS, min((page + 1) * PAGE_ROWS, self.count))
            np.take(source, rows[places], axis=0, out=store[places], mode="clip")

        self._in_threads(fill, range(self.pages))

    def download(self, name: str) -> NDArray[Any]:
        """An array of all rows, as a copy."""
        self.settle()
        return self.in_rows(self._rows_of(name))

    def in_rows(self, places: NDArray[Any]) -> NDArray[Any]:
        """Values by places, as `add_to` returns them, in the order of rows."""
        return np.take(places, self._place, axis=0)

    def arranged(self, rows: NDArray[Any]) -> NDArray[Any]:
        """Values by rows, by their places."""
        return np.take(rows, self._order, axis=0)

    def add_to(self, name: str, total: NDArray[Any] | None) -> NDArray[Any]:
        """Add an array to a sum of earlier ones, by places; None: it begins."""
        self.settle()
        stored = self._rows_of(name)[:self.count]
        if total is None:
            return stored.copy()
        sums = total

        def add(page: int) -> None:
            sums[page * PAGE_ROWS:(page + 1) * PAGE_ROWS] += stored[
                page * PAGE_ROWS:(page + 1) * PAGE_ROWS]

        self._in_threads(add, range(self.pages))
        return total

    def write(self, name: str, values: NDArray[Any], first: int = 0) -> None:
        """Overwrite rows of an array from row `first` on."""
        self.leave()
        self._rows_of(name)[self._place[first:first + len(values)]] = values

    def regrow(self, source: NDArray[np.uint32], kept: int, positions: NDArray[np.floating],
               inherited: str) -> None:
        """Rearrange the rows as growth does (`Growth`), where `positions` are those of the new
        rows: all take over the array `inherited`, and new ones are 0 in the others."""
        self.leave()
        places = self._place[source]
        self._arrange(positions)
        for name in self._specs:
            old, self._stores[name] = self._rows_of(name), self._new_store(name)
            self._fill(name, old, places[self._order])
            if name != inherited:
                self._rows_of(name)[self._place[kept:]] = 0
        self._make_slots(0)

    # --- slots on the device

    @property
    def page_bytes(self) -> int:
        """Of all arrays."""
        return 4 * sum(self._words.values())

    def leave(self) -> None:
        """Take all pages to the host, and give back the memory of the slots, of which there may be
        more later."""
        self.settle()
        self._make_slots(0)
        self._most = self.pages

    def _make_slots(self, room: int) -> None:
        self.room, self.layout = room, object()
        self.arrays: dict[str, Array] = {}
        self._transits = list[_Transit]()
        rows = max(1, room * PAGE_ROWS)
        self.arrays = {name: self.device.zeros((rows, *spec.shape), spec.dtype)
                       for name, spec in self._specs.items()}
        self._slot = np.full(self.pages, -1)  # of each page; -1: none
        self._page = np.full(room, -1)  # of each slot; -1: none
        self._changed = np.zeros(room, bool)  # slots of which the host has an old copy
        self._used = np.zeros(room, np.int64)  # when each slot was wanted last
        self._now = 0
        self.slots.fill(ABSENT)
        if room:
            self._transits = [_Transit(self.device, self._words, self._staged_pages(room))
                              for _ in range(TURNS)]
            self._tables = [_Table(pinned(self.device, (self.pages,))) for _ in range(TURNS)]

    def shrink(self, nbytes: int) -> None:
        """Give back at least so many bytes of slots; OutOfDeviceMemory where there are none."""
        fewer = self.room - max(1, -(-nbytes // self.page_bytes))
        if fewer < 1:
            raise OutOfDeviceMemory(
                f"{self.device.name}: no room for the harmonics of {PAGE_ROWS:,} gaussians: use a "
                "larger --memory-budget, --max-gaussians or --sh-degree")
        self.settle()
        self._make_slots(fewer)
        self._most = fewer

    def note_change(self) -> None:
        """Note that a launch that follows may change all pages that have a slot."""
        self._changed[self._page >= 0] = True

    def fetch(self, wanted: NDArray[np.bool_],
              wanted_next: Callable[[], NDArray[np.integer]] | None = None) -> None:
        """Bring pages, bool[pages], to the device; TooFewPages where they do not fit.

        `wanted_next` returns when each page will be wanted again, int[pages]: those that will be
        last leave first (Belady 1966), and of these those that were not wanted for longest.
        """
        number = int(wanted.sum())
        if self.room < min(number, self._most) or not self.room:
            self.settle()  # there may be memory for more by now
            self._make_slots(0)
            free = self._free() // self.page_bytes
            self._make_slots(min(self._most, max(1, free - TURNS * self._staged_pages(free))))
        if number > self.room:
            raise TooFewPages(
                f"{self.device.name}: a view sees {number * PAGE_ROWS:,} gaussians, and there is "
                f"room for the harmonics of {self.room * PAGE_ROWS:,}: use a larger "
                "--memory-budget, --max-gaussians or --sh-degree")
        self._now += 1
        here = self._slot[wanted]
        self._used[here[here >= 0]] = self._now
        missing = np.flatnonzero(wanted & (self._slot < 0))
        if not len(missing):
            return
        staying = self._used / (self._now + 1)  # of the pages of slots; less than 1
        if wanted_next and len(missing) > (self._page < 0).sum():
            staying -= wanted_next()[self._page]
        staying[self._slot[wanted & (self._slot >= 0)]] = np.inf
        staying[self._page < 0] = -np.inf
        taken = np.argpartition(staying, len(missing) - 1)[:len(missing)]
        self._take_out(taken[self._changed[taken]])
        gone = self._page[taken]
        self._slot[gone[gone >= 0]] = -1
        self._slot[missing], self._page[taken], self._used[taken] = taken, missing, self._now
        self._bring(taken, missing)
        self._write_table()

    def bring(self, wanted: NDArray[np.bool_],
              wanted_next: Callable[[], NDArray[np.integer]] | None = None) -> bool:
        """As `fetch`; False where these pages do not fit."""
        try:
            self.fetch(wanted, wanted_next)
        except TooFewPages:
            return False
        return True

    def rounds_of(self, rows: NDArray[np.uint32]
                  ) -> Iterator[tuple[NDArray[np.uint32], NDArray[np.uint32]]]:
        """Bring the pages of some rows, one group after another: the index and the number of those
        that are there then."""
        page_of = self._place[rows] // PAGE_ROWS
        wanted = np.unique(page_of)
        for begin in range(0, len(wanted), self.room):
            some = np.zeros(self.pages, bool)
            some[wanted[begin:begin + self.room]] = True
            self.fetch(some)
            index = np.flatnonzero(some[page_of]).astype(np.uint32)
            yield index, rows[index]

    def rounds(self, most: int = 2**32) -> Iterator[NDArray[np.uint32]]:
        """Bring all pages to the device, one group after another: the rows of each, at most so
        many and at least those of a page."""
        self.fetch(np.zeros(self.pages, bool))  # so that there are slots
        size = max(1, min(self.room, most // PAGE_ROWS))
        turns = np.argsort(self._slot < 0, kind="stable")  # those that are there first
        for begin in range(0, self.pages, size):
            wanted = np.zeros(self.pages, bool)
            wanted[turns[begin:begin + size]] = True
            self.fetch(wanted)
            yield self._order[np.repeat(wanted, PAGE_ROWS)[:self.count]]

    def settle(self) -> None:
        """Copy all that has changed to the host; the pages stay."""
        self._take_out(np.flatnonzero(self._changed))
        for transit in self._transits:
            self._land(transit)

    def _staged_pages(self, room: int) -> int:
        """How many pages travel together, with so many slots."""
        return max(1, min(STAGED_BYTES // self.page_bytes, room // (8 * TURNS)))

    def _next_transit(self) -> _Transit:
        """The one that began longest ago, free."""
        self._transits.append(transit := self._transits.pop(0))
        self._land(transit)
        return transit

    def _take_out(self, slots: NDArray[np.int64]) -> None:
        """Begin to copy the pages of slots to the host."""
        while len(slots):
            transit = self._next_transit()
            some, slots = np.split(slots, [len(transit.slots)])
            self._begin(transit, some)
            self._transfers.let_kernels_wait(transit.travelled[-1])
            for name in self._words:
                self._copy(name, transit, len(some), False)
            transit.used, transit.pages = self._transfers.after_kernels(), self._page[some]
            transit.travelled += [
                self._transfers.read(transit.staged[name].narrow(len(some)),
                                     transit.host[name][:len(some)], transit.used)
                for name in self._words]
            self._changed[some] = False

    def _land(self, transit: _Transit) -> None:
        """Wait for pages that are on their way."""
        for event in transit.travelled:
            event.wait()
        transit.travelled.clear()

        def land(at: int) -> None:
            for name, values in transit.host.items():
                self._stores[name][transit.pages[at]] = values[at]

        self._in_threads(land, range(len(transit.pages)))
        transit.pages = transit.pages[:0]

    def _bring(self, slots: NDArray[np.int64], pages: NDArray[np.int64]) -> None:
        """Begin to copy pages to slots."""
        for transit in self._transits:  # a page may still be on its way to the host
            if np.isin(pages, transit.pages).any():
                self._land(transit)
        while len(slots):
            transit = self._next_transit()
            most = [len(transit.slots)]
            (some, slots), (coming, pages) = np.split(slots, most), np.split(pages, most)

            def load(at: int, transit: _Transit = transit,
                     coming: NDArray[np.int64] = coming) -> None:
                for name, values in transit.host.items():
                    values[at] = self._stores[name][coming[at]]

            self._in_threads(load, range(len(some)))
            self._begin(transit, some)
            for name in self._words:
                transit.travelled.append(self._transfers.write(
                    transit.staged[name].narrow(len(some)), transit.host[name][:len(some)],
                    transit.used))
            self._transfers.let_kernels_wait(transit.travelled[-1])
            for name in self._words:
                self._copy(name, transit, len(some), True)
            transit.used = self._transfers.after_kernels()

    def _begin(self, transit: _Transit, slots: NDArray[np.int64]) -> None:
        """Bring the list of slots from or to which pages travel."""
        transit.slots[:len(slots)] = slots
        transit.travelled.append(self._transfers.write(transit.list, transit.slots, transit.used))

    def _write_table(self) -> None:
        """Let the kernels that follow know where pages are."""
        turn = self._tables.pop(0)
        if turn.writing:
            turn.writing.wait()
        turn.host[:] = np.where(self._slot < 0, ABSENT, self._slot)
        turn.writing = Writing(self.slots, turn.host)
        self._tables.append(turn)

    def _copy(self, name: str, transit: _Transit, count: int, brings: bool) -> None:
        """Copy pages of an array between their slots and the memory of a transit."""
        array = self.arrays[name]
        pages = array.reshaped(self.room, math.prod(array.shape) // self.room)
        self.device.launch(COPY, count=count, quads=4 * self._words[name] // QUAD,
                           brings=int(brings), list=transit.list.narrow(count),
                           slots=pages.viewed(np.uint32), staged=transit.staged[name].narrow(count))

    def _in_threads(self, work: Callable[[int], Any], numbers: Iterable[int]) -> None:
        for _ in self._threads.map(work, numbers):
            pass

    # --- what frames need

    def mark(self, flags: Array, wanted: Array | None = None) -> Array:
        """Set wanted, uint[pages], where a page has a row whose flag, uint[N], is 1; None: a new
        array."""
        if wanted is None:
            wanted = self.device.empty(self.pages, np.uint32)
            wanted.fill(0)
        self.device.launch(MARK, count=self.count, flags=flags, places=self.places, wanted=wanted)
        return wanted

    def require(self, flags: Array, counts: Array, clears: bool) -> None:
        """Let the frame of `counts` fail where a page of flagged rows, or of rows that were flagged
        since it was cleared, has no slot."""
        self.mark(flags, self._wanted)
        self.device.launch(REQUIRE, pages=self.pages, clears=int(clears), slots=self.slots,
                           wanted=self._wanted, counts=counts)

    def rest_of(self, rows: Array) -> Array:
        """uint[C], where the rows uint[C] lie in `arrays`; their pages must be there."""
        lies = self.device.empty(len(rows), np.uint32)
        self.device.launch(REST_ROWS, PAGED, count=len(rows), rows=rows, places=self.places,
                           slots=self.slots, lies=lies)
        return lies


def host_memory() -> float:
    """Bytes of memory of this computer, as far as that can be known."""
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, ValueError, OSError):
        return math.inf


def spatial_order(positions: NDArray[np.floating]) -> NDArray[np.uint32]:
    """uint32[N], rows in an order in which neighbours are near each other (Morton 1966)."""
    finite = np.nan_to_num(positions.astype(np.float32), posinf=0, neginf=0)
    low, high = np.quantile(finite[::max(1, len(finite) // 10_000)], (0.01, 0.99), axis=0)
    scale = (1 << BITS) / max(float((high - low).max()), 1e-30)  # cells are cubes
    cells = np.clip((finite - low) * scale, 0, (1 << BITS) - 1).astype(np.uint32)
    keys = np.zeros(len(cells), np.uint32)
    for axis in range(3):
        keys |= _spread(cells[:, axis]) << np.uint32(axis)
    order = np.argsort(keys.astype(np.uint16), kind="stable")  # by 16 bits, numpy sorts by digits
    upper = (keys >> np.uint32(16)).astype(np.uint16)[order]
    return order[np.argsort(upper, kind="stable")].astype(np.uint32)


def _spread(values: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """The lower 10 bits of numbers, two zeros between any two."""
    for shift, mask in ((16, 0x030000ff), (8, 0x0300f00f), (4, 0x030c30c3), (2, 0x09249249)):
        values = (values | values << np.uint32(shift)) & np.uint32(mask)
    return values
