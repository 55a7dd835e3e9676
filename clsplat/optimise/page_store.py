"""All pages of harmonics and their moments, in host memory, for models larger than the device."""

from __future__ import annotations

import math
import os
import sys
import tempfile
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import PAGE_ROWS
from clsplat.errors import InputError, reason

HOST_SHARE = 0.5  # of the host's memory that pages may take
THREADS = min(8, os.cpu_count() or 1)  # that copy pages
Part = TypeVar("Part")
BITS = 10  # of each coordinate in the order of pages


class PageStore:
    """Rows of some arrays in pages of PAGE_ROWS; rows near each other in space share one.

    Parameters
    ----------
    positions : float[N, 3], by which rows are put in pages.
    values : name of an array -> [N, *row shape], whose values are copied.
    folder : of the file of what host memory cannot hold; None: that of temporary files.

    Attributes
    ----------
    count, pages : the number of rows and of pages.
    order : uint32[N], the row of each place; the places of page p begin at p * PAGE_ROWS.
    place : uint32[N], the place of each row.
    words : name -> the number of 4 bytes in a page.
    contents : name -> uint32[pages, words].
    """

    def __init__(self, positions: NDArray[np.floating], values: Mapping[str, NDArray[Any]],
                 folder: Path | None = None) -> None:
        self._folder, self._threads = folder, ThreadPoolExecutor(THREADS)
        self._kinds = {name: (rows.shape[1:], rows.dtype) for name, rows in values.items()}
        self.words = {name: PAGE_ROWS * math.prod(shape) * dtype.itemsize // 4
                      for name, (shape, dtype) in self._kinds.items()}
        self._arrange(positions)
        self.contents = {name: self._zeros(name) for name in values}
        for name, rows in values.items():
            self._fill(name, rows, self.order)

    @property
    def page_bytes(self) -> int:
        """Of all arrays."""
        return 4 * sum(self.words.values())

    def kind(self, name: str) -> tuple[tuple[int, ...], np.dtype[Any]]:
        """The shape of a row of an array, and its type."""
        return self._kinds[name]

    def _arrange(self, positions: NDArray[np.floating]) -> None:
        self.count, self.pages = len(positions), max(1, -(-len(positions) // PAGE_ROWS))
        self.order = spatial_order(positions)
        self.place = np.empty(self.count, np.uint32)
        self.place[self.order] = np.arange(self.count, dtype=np.uint32)

    def _zeros(self, name: str) -> NDArray[np.uint32]:
        """Zeros for all pages of an array; in a file without a name where the host has too little
        memory for all arrays."""
        shape = self.pages, self.words[name]
        if self.pages * self.page_bytes <= HOST_SHARE * host_memory():
            return np.zeros(shape, np.uint32)
        folder, nbytes = self._folder or Path(tempfile.gettempdir()), 4 * math.prod(shape)
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

    def _fill(self, name: str, source: NDArray[Any], rows: NDArray[np.uint32]) -> None:
        """Put these rows of an array at the places, in their order."""
        values = self.rows(name)

        def fill(page: int) -> None:
            places = slice(page * PAGE_ROWS, min((page + 1) * PAGE_ROWS, self.count))
            np.take(source, rows[places], axis=0, out=values[places], mode="clip")

        self.in_threads(fill, range(self.pages))

    def in_threads(self, work: Callable[[Part], Any], parts: Iterable[Part]) -> None:
        """Call `work` with each part; waits."""
        for _ in self._threads.map(work, parts):
            pass

    def rows_of(self, pages: NDArray[np.int64]) -> NDArray[np.uint32]:
        """The rows in some pages."""
        places = (pages[:, None] * PAGE_ROWS + np.arange(PAGE_ROWS)).reshape(-1)
        rows: NDArray[np.uint32] = self.order[places[places < self.count]]
        return rows

    def rows(self, name: str) -> NDArray[Any]:
        """[pages * PAGE_ROWS, *row shape], an array by places."""
        shape, dtype = self._kinds[name]
        return self.contents[name].reshape(-1).view(dtype).reshape(-1, *shape)

    def in_rows(self, places: NDArray[Any]) -> NDArray[Any]:
        """Values by places, in the order of rows."""
        return np.take(places, self.place, axis=0)

    def in_places(self, rows: NDArray[Any]) -> NDArray[Any]:
        """Values by rows, in the order of places."""
        return np.take(rows, self.order, axis=0)

    def add_to(self, name: str, total: NDArray[Any] | None) -> NDArray[Any]:
        """Add an array to a sum of earlier ones, by places; None: it begins."""
        values = self.rows(name)[:self.count]
        if total is None:
            return values.copy()
        sums = total

        def add(page: int) -> None:
            places = slice(page * PAGE_ROWS, (page + 1) * PAGE_ROWS)
            sums[places] += values[places]

        self.in_threads(add, range(self.pages))
        return total

    def regrow(self, source: NDArray[np.uint32], kept: int, positions: NDArray[np.floating],
               inherited: str) -> None:
        """Rearrange the rows as growth does (`Growth`), where `positions` are those of the new
        rows: all take over the array `inherited`, and new ones are 0 in the others."""
        places = self.place[source]
        self._arrange(positions)
        for name in self._kinds:
            old, self.contents[name] = self.rows(name), self._zeros(name)
            self._fill(name, old, places[self.order])
            if name != inherited:
                self.rows(name)[self.place[kept:]] = 0


def host_memory() -> float:
    """Bytes of memory of this computer, as far as that can be known."""
    if sys.platform == "win32":
        return math.inf
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (ValueError, OSError):
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
