"""Pages of harmonics and their moments, for models larger than the device (cl/pages.cl).

Three quarters of a gaussian are its harmonics above the constant and their moments, and only a view
that sees it needs them. Rows that are near each other in space share a page of PAGE_ROWS. All pages
are in host memory, or in a file where that is too small; those that views see now have a slot on
the device. What is computed does not depend on which these are: a frame that wants a page without a
slot fails, and is repeated once the page is there (units.py).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import FRAME_COUNTS, PAGE_ABSENT, PAGE_ROWS
from clsplat.device import Array, Device, Kernel, Transfers, Writing, each, pinned
from clsplat.errors import OutOfDeviceMemory, TooFewPages
from clsplat.optimise.page_store import PageStore

TABLES = 8  # copies of `Pages.slots` that are on their way at the same time
FREED_SHARE = 1 / 64  # of the slots: so many more than needed get free at a time
MANY_MORE = 1.1  # times as many slots, for which all are made anew
PAGED = (("PAGED", 1),)

MARK = Kernel(
    "pages.cl",
    "mark_pages",
    each("count"),
    count="uint",
    flags=("uint", "N"),
    places=("uint", "N"),
    wanted=("uint", "Q"),
)
REQUIRE = Kernel(
    "pages.cl",
    "require_pages",
    each("pages"),
    pages="uint",
    clears="uint",
    slots=("uint", "Q"),
    wanted=("uint", "Q"),
    counts=("uint", FRAME_COUNTS),
)
REST_ROWS = Kernel(
    "pages.cl",
    "rest_rows",
    each("count"),
    count="uint",
    rows=("uint", "C"),
    places=("uint", "N"),
    slots=("uint", "Q"),
    lies=("uint", "C"),
)


@dataclass(eq=False)
class _Table:
    """A copy of `Pages.slots` in host memory, and its way to the device."""

    host: NDArray[np.uint32]
    writing: Writing | None = None


class Pages:
    """The pages of a store that have a slot on the device.

    Parameters
    ----------
    store : all pages.
    free : returns how many bytes of device memory pages may take now.

    Attributes
    ----------
    arrays : name -> [slots * PAGE_ROWS, *row shape], the pages on the device.
    places : uint[N], the place of a row in the order of all pages.
    slots : uint[pages], where a page is (cl/include/rest.h).
    room : the number of slots; 0: there is no memory on the device.
    layout : another object after each change of the arrays.
    """

    def __init__(self, device: Device, store: PageStore, free: Callable[[], int]) -> None:
        self.device, self.store, self._free = device, store, free
        self._transfers = Transfers(device)
        self._arranged()

    def _arranged(self) -> None:
        """Take over the order of the store; no page has a slot."""
        store, self.pages = self.store, self.store.pages
        self._most = self.pages  # slots, as far as is known
        self.places = self.device.upload(store.place)
        self.slots = self.device.allocate(self.pages, np.uint32)
        self._wanted = self.device.zeros(self.pages, np.uint32)  # by frames under way
        self._make_slots(0)

    def download(self, name: str) -> NDArray[Any]:
        """An array of all rows, as a copy."""
        self.settle()
        return self.store.read(name)

    def add_to(self, name: str, total: NDArray[Any]) -> None:
        """As `PageStore.add_to`."""
        self._take_out(np.flatnonzero(self._changed), name)
        self._transfers.finish()
        self.store.add_to(name, total)

    def write(self, name: str, values: NDArray[Any], first: int = 0) -> None:
        """As `PageStore.write`."""
        self.leave()
        self.store.write(name, values, first)

    def regrow(self, source: NDArray[np.uint32], kept: int, positions: NDArray[np.floating], inherited: str) -> None:
        """As `PageStore.regrow`."""
        self.leave()
        self.store.regrow(source, kept, positions, inherited)
        self._arranged()

    def leave(self) -> None:
        """Take all pages to the host, and give back the memory of the slots, of which there may be
        more later."""
        self.settle()
        self._make_slots(0)
        self._most = self.pages

    def _make_slots(self, room: int) -> None:
        self.room, self.layout = room, object()
        self.arrays: dict[str, Array] = {}
        self._slots_of: dict[str, Array] = {}  # the same as uint[slots, words]
        rows = max(1, room) * PAGE_ROWS
        for name in self.store.words:
            shape, dtype = self.store.kind(name)
            array = self.arrays[name] = self.device.zeros((rows, *shape), dtype)
            width = math.prod(shape) * PAGE_ROWS
            self._slots_of[name] = array.reshaped(max(1, room), width).viewed(np.uint32)
        self._slot = np.full(self.pages, -1)  # of each page; -1: none
        self._page = np.full(room, -1)  # of each slot; -1: none
        self._changed = np.zeros(room, bool)  # slots of which the host has an old copy
        self._used = np.zeros(room, np.int64)  # when each slot was wanted last
        self._now = 0
        self.slots.fill(PAGE_ABSENT)
        self._transfers.follow_kernels()  # which fill the arrays
        if room:
            self._tables = [_Table(pinned(self.device, (self.pages,))) for _ in range(TABLES)]

    def shrink(self, nbytes: int) -> None:
        """Give back at least so many bytes of slots; OutOfDeviceMemory where there are none."""
        fewer = self.room - max(1, -(-nbytes // self.store.page_bytes))
        if fewer < 1:
            raise OutOfDeviceMemory(
                f"{self.device.name}: no room for the harmonics of {PAGE_ROWS:,} gaussians: use a "
                "larger --memory-budget, --max-gaussians or --sh-degree"
            )
        self.settle()
        self._make_slots(fewer)
        self._most = fewer

    def note_change(self) -> None:
        """Note that a launch that follows may change all pages that have a slot."""
        self._changed[self._page >= 0] = True

    def fetch(self, wanted: NDArray[np.bool_], wanted_next: Callable[[], NDArray[np.integer]] | None = None) -> None:
        """Bring pages, bool[pages], to the device; TooFewPages where they do not fit.

        `wanted_next` returns when each page will be wanted again, int[pages]: those that will be
        last leave first (Belady 1966), and of these those that were not wanted for longest.
        """
        number = int(wanted.sum())
        if self.room < min(number, self._most) or not self.room:
            self.settle()  # there may be memory for more by now
            self._make_slots(0)
            self._make_slots(self._possible())
        if number > self.room:
            raise TooFewPages(
                f"{self.device.name}: a view sees {number * PAGE_ROWS:,} gaussians, and there is "
                f"room for the harmonics of {self.room * PAGE_ROWS:,}: use a larger "
                "--memory-budget, --max-gaussians or --sh-degree"
            )
        self._now += 1
        here = self._slot[wanted]
        self._used[here[here >= 0]] = self._now
        missing = np.flatnonzero(wanted & (self._slot < 0))
        if not len(missing):
            return
        free = np.flatnonzero(self._page < 0)
        if len(free) < len(missing):
            self._free_slots(len(missing) - len(free), wanted, wanted_next)
            free = np.flatnonzero(self._page < 0)
        taken = free[: len(missing)]
        self._slot[missing], self._page[taken], self._used[taken] = taken, missing, self._now
        self._bring(taken, missing)
        self._write_table()

    def _free_slots(
        self, least: int, wanted: NDArray[np.bool_], wanted_next: Callable[[], NDArray[np.integer]] | None
    ) -> None:
        """Take out at least so many pages, and some more, of those that are not wanted."""
        staying = self._used / (self._now + 1)  # less than 1
        if wanted_next:
            staying -= wanted_next()[self._page]
        here = self._slot[wanted]
        staying[here[here >= 0]] = staying[self._page < 0] = np.inf
        number = min(least + int(FREED_SHARE * self.room), int(np.isfinite(staying).sum()))
        taken = np.argpartition(staying, number - 1)[:number]
        self._take_out(taken[self._changed[taken]])
        self._slot[self._page[taken]], self._page[taken] = -1, -1

    def bring(self, wanted: NDArray[np.bool_], wanted_next: Callable[[], NDArray[np.integer]] | None = None) -> bool:
        """As `fetch`; False where these pages do not fit."""
        try:
            self.fetch(wanted, wanted_next)
        except TooFewPages:
            return False
        return True

    def rounds_of(self, rows: NDArray[np.uint32]) -> Iterator[tuple[NDArray[np.uint32], NDArray[np.uint32]]]:
        """Bring the pages of some rows, one group after another: the index and the number of those
        that are there then."""
        page_of = self.store.place[rows] // PAGE_ROWS
        wanted = np.unique(page_of)
        for begin in range(0, len(wanted), self.room):
            some = np.zeros(self.pages, bool)
            some[wanted[begin : begin + self.room]] = True
            self.fetch(some)
            index = np.flatnonzero(some[page_of]).astype(np.uint32)
            yield index, rows[index]

    def rounds(self, most: int = 2**32) -> Iterator[NDArray[np.int64]]:
        """Bring all pages to the device, one group after another, and those that are there first:
        the pages of each, of at most so many rows and at least one."""
        self.fetch(np.zeros(self.pages, bool))  # so that there are slots
        there, size = self._slot >= 0, max(1, min(self.room, most // PAGE_ROWS))
        few = max(1, min(size, int(FREED_SHARE * self.room)))  # others take turns in a few slots
        for pages, together in ((np.flatnonzero(there), size), (np.flatnonzero(~there), few)):
            for begin in range(0, len(pages), together):
                group = pages[begin : begin + together]
                wanted = np.zeros(self.pages, bool)
                wanted[group] = True
                self.fetch(wanted)
                yield group
                if together == few:
                    self._used[self._slot[group]] = 0  # they are the first to leave

    def settle(self) -> None:
        """Copy all that has changed to the host; the pages stay."""
        self._take_out(np.flatnonzero(self._changed))
        self._transfers.finish()

    def _possible(self) -> int:
        """How many slots there may be, where there are none."""
        free = self._free() // self.store.page_bytes
        in_a_buffer = self.device.largest_buffer // (4 * max(self.store.words.values()))
        return min(self._most, in_a_buffer, max(1, free))

    def leave_for_more(self) -> bool:
        """Take all pages to the host if there is memory for many more slots; whether it is so."""
        has = self.room
        possible = min(self._most, has + max(0, self._free()) // self.store.page_bytes)
        if not has or possible < MANY_MORE * has:
            return False
        self.leave()
        return True

    def _take_out(self, slots: NDArray[np.int64], only: str = "") -> None:
        """Begin to copy the pages of slots to the host, or `only` one of the arrays, once all
        kernels so far have ended; what comes to these slots later does so after that."""
        self._transfers.follow_kernels()
        for name, first, page, count in self._runs(slots, self._page[slots], only):
            self._transfers.read(self._slots_of[name], first, self.store.memory(name, page, count))
        if not only:
            self._changed[slots] = False

    def _bring(self, slots: NDArray[np.int64], pages: NDArray[np.int64]) -> None:
        """Begin to copy pages to slots; kernels that follow wait for the end of it."""
        for name, first, page, count in self._runs(slots, pages):
            self._transfers.write(self._slots_of[name], first, self.store.memory(name, page, count))
        self._transfers.lead_kernels()

    def _runs(
        self, slots: NDArray[np.int64], pages: NDArray[np.int64], only: str = ""
    ) -> Iterator[tuple[str, int, int, int]]:
        """(Name of an array, first slot, first page, their number) of all that travel together, as
        they are neighbours on both sides; `only` of one array."""
        order = np.argsort(slots)
        slots, pages = slots[order], pages[order]
        for name in ([only] if only else self.store.words) if len(slots) else ():
            ends = (np.diff(slots) != 1) | (np.diff(pages) != 1) | (np.diff(self.store.together(name, pages)) != 0)
            firsts = np.concatenate([[0], np.flatnonzero(ends) + 1, [len(slots)]])
            for first, count in zip(firsts.tolist(), np.diff(firsts).tolist()):
                yield name, int(slots[first]), int(pages[first]), count

    def _write_table(self) -> None:
        """Let the kernels that follow know where pages are."""
        turn = self._tables.pop(0)
        if turn.writing:
            turn.writing.wait()
        turn.host[:] = np.where(self._slot < 0, PAGE_ABSENT, self._slot)
        turn.writing = Writing(self.slots, turn.host)
        self._tables.append(turn)

    # --- what frames need

    def mark(self, flags: Array, wanted: Array | None = None) -> Array:
        """Set wanted, uint[pages], where a page has a row whose flag, uint[N], is 1; None: a new
        array."""
        if wanted is None:
            wanted = self.device.empty(self.pages, np.uint32)
            wanted.fill(0)
        self.device.launch(MARK, count=len(flags), flags=flags, places=self.places, wanted=wanted)
        return wanted

    def require(self, flags: Array, counts: Array, clears: bool) -> None:
        """Let the frame of `counts` fail where a page of flagged rows, or of rows that were flagged
        since it was cleared, has no slot."""
        self.mark(flags, self._wanted)
        self.device.launch(
            REQUIRE, pages=self.pages, clears=int(clears), slots=self.slots, wanted=self._wanted, counts=counts
        )

    def rest_of(self, rows: Array) -> Array:
        """uint[C], where the rows uint[C] lie in `arrays`; their pages must be there."""
        lies = self.device.empty(len(rows), np.uint32)
        self.device.launch(
            REST_ROWS, PAGED, count=len(rows), rows=rows, places=self.places, slots=self.slots, lies=lies
        )
        return lies
