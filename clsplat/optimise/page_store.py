"""All pages of harmonics and their moments, in host memory, for models larger than the device."""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import PAGE_ROWS
from clsplat.device.host import host_memory
from clsplat.errors import InputError, reason

HOST_SHARE = 0.5  # of the host's memory that pages may take
THREADS = min(8, os.cpu_count() or 1)  # that copy pages
BLOCK_WORDS = 1 << 24  # of memory, in 4 bytes: few devices make one of all pages
SPAN = 32  # pages that a thread copies at a time
BITS = 10  # of each coordinate in the order of pages

Words = NDArray[np.uint32]


class PageStore:
    """Rows of some arrays in pages of PAGE_ROWS; rows near each other in space share one.

    Parameters
    ----------
    positions : float[N, 3], by which rows are put in pages.
    values : name of an array -> [N, *row shape], whose values are copied.
    folder : of the file of what host memory cannot hold; None: that of temporary files.
    allocate : makes host memory of so many numbers, as a device reads at full speed; None: any.

    Attributes
    ----------
    count, pages : the number of rows and of pages.
    order : uint32[N], the row of each place; the places of page p begin at p * PAGE_ROWS.
    place : uint32[N], the place of each row.
    words : name -> the number of 4 bytes in a page.
    """

    def __init__(
        self,
        positions: NDArray[np.floating],
        values: Mapping[str, NDArray[Any]],
        folder: Path | None = None,
        allocate: Callable[[int], Words] | None = None,
    ) -> None:
        self._folder, self._allocate = folder, allocate or _words
        self._threads, self._spare = ThreadPoolExecutor(THREADS), list[Words]()
        self._kinds = {name: (rows.shape[1:], rows.dtype) for name, rows in values.items()}
        self.words = {
            name: PAGE_ROWS * math.prod(shape) * dtype.itemsize // 4 for name, (shape, dtype) in self._kinds.items()
        }
        self._together = {
            name: max(1, BLOCK_WORDS // each)  # pages in a block of memory
            for name, each in self.words.items()
        }
        self._arrange(positions)
        self._blocks = {name: self._new_blocks(name) for name in values}
        for name, rows in values.items():
            self._fill(name, partial(np.take, rows, axis=0))

    @property
    def page_bytes(self) -> int:
        """Of all arrays."""
        return 4 * sum(self.words.values())

    def kind(self, name: str) -> tuple[tuple[int, ...], np.dtype[Any]]:
        """The shape of a row of an array, and its type."""
        return self._kinds[name]

    def memory(self, name: str, first: int, count: int = 1) -> Words:
        """uint32[count, words], pages of an array from `first` on, which lie in one block."""
        block, place = divmod(first, self._together[name])
        words = self.words[name]
        return self._blocks[name][block][place * words : (place + count) * words].reshape(-1, words)

    def together(self, name: str, pages: NDArray[np.integer]) -> NDArray[np.integer]:
        """The block in which each of the pages of an array lies."""
        return pages // self._together[name]

    def _on_pages(self, name: str, work: Callable[[NDArray[Any], NDArray[np.uint32]], Any]) -> None:
        """Call `work` with rows of an array, as they are in some pages, and their numbers, for all
        pages in threads; waits."""
        shape, dtype = self._kinds[name]
        together = self._together[name]

        def of_pages(first: int) -> None:
            count = min(SPAN, together - first % together, self.pages - first)
            numbers = self.order[first * PAGE_ROWS : (first + count) * PAGE_ROWS]
            memory = self.memory(name, first, count).reshape(-1).view(dtype).reshape(-1, *shape)
            work(memory[: len(numbers)], numbers)

        firsts = [
            first
            for block in range(0, self.pages, together)
            for first in range(block, min(block + together, self.pages), SPAN)
        ]
        for _ in self._threads.map(of_pages, firsts):
            pass

    def _arrange(self, positions: NDArray[np.floating]) -> None:
        self.count, self.pages = len(positions), max(1, -(-len(positions) // PAGE_ROWS))
        self.order = spatial_order(positions)
        self.place = np.empty(self.count, np.uint32)
        self.place[self.order] = np.arange(self.count, dtype=np.uint32)

    def _new_blocks(self, name: str) -> list[Words]:
        """Memory for all pages of an array; a file without a name where the host has too little for
        all arrays."""
        together, words = self._together[name], self.words[name]
        if self.pages * self.page_bytes > HOST_SHARE * host_memory():
            whole = self._file(self.pages * words)
            return [whole[first * words : (first + together) * words] for first in range(0, self.pages, together)]
        size = max(BLOCK_WORDS, *self.words.values())
        return [self._spare.pop() if self._spare else self._allocate(size) for _ in range(0, self.pages, together)]

    def _file(self, words: int) -> Words:
        folder, nbytes = self._folder or Path(tempfile.gettempdir()), 4 * words
        try:
            with tempfile.TemporaryFile(dir=folder) as file:
                if hasattr(os, "posix_fallocate"):  # or a full disk would end the process later
                    os.posix_fallocate(file.fileno(), 0, nbytes)
                    return np.memmap(file, np.uint32, "r+", shape=words)
                return np.memmap(file, np.uint32, "w+", shape=words)
        except OSError as error:
            raise InputError(
                f"{folder}: no room for {nbytes >> 20:,} MiB of gaussians that fit neither the "
                f"device nor the host's memory ({reason(error)}); free some, or use "
                "--max-gaussians"
            ) from None

    def _fill(self, name: str, rows_of: Callable[[NDArray[np.uint32]], NDArray[Any]]) -> None:
        """Put rows of an array in all pages; `rows_of` returns those of these numbers."""

        def fill(rows: NDArray[Any], numbers: NDArray[np.uint32]) -> None:
            rows[:] = rows_of(numbers)

        self._on_pages(name, fill)

    def rows_of(self, pages: NDArray[np.int64]) -> NDArray[np.uint32]:
        """The rows in some pages."""
        places = (pages[:, None] * PAGE_ROWS + np.arange(PAGE_ROWS)).reshape(-1)
        rows: NDArray[np.uint32] = self.order[places[places < self.count]]
        return rows

    def read(self, name: str) -> NDArray[Any]:
        """An array of all rows, as a copy."""
        shape, dtype = self._kinds[name]
        found = np.empty((self.count, *shape), dtype)

        def read(rows: NDArray[Any], numbers: NDArray[np.uint32]) -> None:
            found[numbers] = rows

        self._on_pages(name, read)
        return found

    def write(self, name: str, values: NDArray[Any], first: int = 0) -> None:
        """Overwrite rows of an array from row `first` on."""

        def write(rows: NDArray[Any], numbers: NDArray[np.uint32]) -> None:
            some = np.flatnonzero((numbers >= first) & (numbers < first + len(values)))
            rows[some] = values[numbers[some] - first]

        self._on_pages(name, write)

    def add_to(self, name: str, total: NDArray[Any]) -> None:
        """Add an array to a sum of earlier ones."""

        def add(rows: NDArray[Any], numbers: NDArray[np.uint32]) -> None:
            total[numbers] += rows

        self._on_pages(name, add)

    def regrow(self, source: NDArray[np.uint32], kept: int, positions: NDArray[np.floating], inherited: str) -> None:
        """Rearrange the rows as growth does (`Growth`), where `positions` are those of the new
        rows: all take over the array `inherited`, and new ones are 0 in the others."""
        places = self.place[source]
        self._arrange(positions)
        for name in self._kinds:
            old = self._blocks.pop(name)
            self._blocks[name] = self._new_blocks(name)
            self._fill(name, partial(self._inherited, name, old, places, self.count if name == inherited else kept))
            if not isinstance(old[0], np.memmap):
                self._spare += old

    def _inherited(
        self, name: str, old: list[Words], places: NDArray[np.uint32], kept: int, rows: NDArray[np.uint32]
    ) -> NDArray[Any]:
        """Rows of an array, from the old blocks and the places that each had there; those from
        `kept` on are 0."""
        shape, dtype = self._kinds[name]
        words = self._together[name] * self.words[name]
        block, place = np.divmod(places[rows], PAGE_ROWS * self._together[name])
        found = np.empty((len(rows), *shape), dtype)
        for each in range(int(block.min()), int(block.max()) + 1):  # nearly always one or two
            some = np.flatnonzero(block == each)
            found[some] = np.take(old[each][:words].view(dtype).reshape(-1, *shape), place[some], 0)
        found[rows >= kept] = 0
        return found


def _words(number: int) -> Words:
    return np.empty(number, np.uint32)


def spatial_order(positions: NDArray[np.floating]) -> NDArray[np.uint32]:
    """uint32[N], rows in an order in which neighbours are near each other (Morton 1966)."""
    finite = np.nan_to_num(positions.astype(np.float32), posinf=0, neginf=0)
    low, high = np.quantile(finite[:: max(1, len(finite) // 10_000)], (0.01, 0.99), axis=0)
    scale = (1 << BITS) / max(float((high - low).max()), 1e-30)  # cells are cubes
    cells = np.clip((finite - low) * scale, 0, (1 << BITS) - 1).astype(np.uint32)
    keys = np.zeros(len(cells), np.uint64)
    for axis in range(3):
        keys |= _spread(cells[:, axis]) << np.uint64(axis)
    # numpy sorts numbers much faster than it finds their order
    return np.sort(keys << np.uint64(32) | np.arange(len(keys), dtype=np.uint64)).astype(np.uint32)


def _spread(values: NDArray[np.uint32]) -> NDArray[np.uint64]:
    """The lower 10 bits of numbers, two zeros between any two."""
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        values = (values | values << np.uint32(shift)) & np.uint32(mask)
    return values.astype(np.uint64)
