"""Memory for short-lived arrays: blocks that are used again instead of given back."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

MOST_SPARE = 2  # sizes of an array that a block may have which it uses again


class Block:
    """A block of device memory, which returns to its arena with the last reference to it.

    Attributes
    ----------
    buffer : a Buffer of pyopencl. Recorded launches may keep it (graph.py); the block can be taken
        again all the same.
    """

    __slots__ = ("buffer", "_free")

    def __init__(self, buffer: Any, free: list[Any]) -> None:
        self.buffer, self._free = buffer, free

    def __del__(self) -> None:
        self._free.append(self.buffer)


class Arena:
    """Blocks by size. Commands of a queue run in order, so that a block can be used again at once.

    Parameters
    ----------
    allocate : bytes -> a new Buffer.

    Attributes
    ----------
    managed_bytes : of all blocks, in use or not.
    """

    def __init__(self, allocate: Callable[[int], Any]) -> None:
        self._allocate = allocate
        self._free: dict[int, list[Any]] = {}
        self.managed_bytes = 0

    def allocate(self, size: int, exact: bool = False) -> Block:
        """A block of at least `size` bytes.

        Parameters
        ----------
        exact : whether a new block has just this size, and an old one may be up to `MOST_SPARE`
            times as large: for the same arrays again and again. Otherwise sizes are rounded up, so
            that arrays of changing sizes find blocks.
        """
        size = size if exact else block_bytes(size)
        fits = [other for other, free in self._free.items()
                if free and size <= other <= (MOST_SPARE * size if exact else size)]
        if fits:
            free = self._free[min(fits)]
            return Block(free.pop(), free)
        buffer = self._allocate(size)
        self.managed_bytes += size
        return Block(buffer, self._free.setdefault(size, []))

    def free_held(self) -> None:
        """Give back the memory of all blocks that are not in use."""
        for size, free in self._free.items():
            self.managed_bytes -= size * len(free)
            free.clear()


def block_bytes(size: int) -> int:
    """The size of a block for `size` bytes: four sizes an octave, as these change with views."""
    unit = 1 << max(0, size.bit_length() - 3)  # a quarter of the leading bit
    return -(-size // unit) * unit
