"""Typed arrays in device memory, and blocks of memory that short-lived ones use again."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pyopencl as cl
from numpy.typing import ArrayLike, DTypeLike, NDArray

from clsplat.errors import ShapeError

if TYPE_CHECKING:
    from clsplat.device.device import Device

MOST_SPARE = 2  # sizes of an array that a block may have which it uses again


class ArraySpec(NamedTuple):
    """An array that its owner allocates, and that estimates of memory count."""

    shape: tuple[int, ...]  # the first axis counts the rows
    dtype: DTypeLike | None = None  # None is the real type of the device

    def nbytes(self, real: np.dtype[Any]) -> int:
        """Bytes on a device whose real type is `real`."""
        return math.prod(self.shape) * np.dtype(real if self.dtype is None else self.dtype).itemsize


class Array:
    """Device memory with a shape and a type; rows are contiguous and the first axis counts them.

    Attributes
    ----------
    block : of memory, which lives as long as the array.
    buffer : its Buffer of pyopencl.
    """

    __slots__ = ("device", "buffer", "block", "shape", "dtype", "nbytes", "__weakref__")

    def __init__(self, device: Device, block: Block, shape: tuple[int, ...], dtype: DTypeLike) -> None:
        self.device, self.block, self.buffer, self.shape = device, block, block.buffer, shape
        self.dtype: np.dtype[Any] = np.dtype(dtype)
        self.nbytes = math.prod(shape) * self.dtype.itemsize

    def __len__(self) -> int:
        return self.shape[0]

    def narrow(self, rows: int) -> Array:
        """The first `rows` rows: the same memory, no copy."""
        if rows > self.shape[0]:
            raise ShapeError(f"cannot narrow {self.shape} to {rows} rows")
        return Array(self.device, self.block, (rows, *self.shape[1:]), self.dtype)

    def reshaped(self, *shape: int) -> Array:
        """The same memory under another shape of equal size."""
        if math.prod(shape) != math.prod(self.shape):
            raise ShapeError(f"cannot reshape {self.shape} to {shape}")
        return Array(self.device, self.block, shape, self.dtype)

    def viewed(self, dtype: DTypeLike) -> Array:
        """The same memory as elements of another type, of which the last axis counts more or less."""
        *axes, last = self.shape
        new = np.dtype(dtype)
        if last * self.dtype.itemsize % new.itemsize:
            raise ShapeError(f"cannot view {self.shape} of {self.dtype} as {new}")
        return Array(self.device, self.block, (*axes, last * self.dtype.itemsize // new.itemsize), new)

    def copied(self) -> Array:
        """A persistent Array with the same values."""
        copy = self.device.allocate(self.shape, self.dtype)
        if self.nbytes:
            cl.enqueue_copy(self.device.queue, copy.buffer, self.buffer, byte_count=self.nbytes)
        return copy

    def download(self, first_row: int = 0) -> NDArray[Any]:
        """A numpy copy of the rows from `first_row` on; waits for everything queued before."""
        host = np.empty((self.shape[0] - first_row, *self.shape[1:]) if first_row else self.shape, self.dtype)
        if host.size:
            self.device.note_wait()
            cl.enqueue_copy(self.device.queue, host, self.buffer, src_offset=self.nbytes - host.nbytes)
        return host

    def write(self, values: ArrayLike, first_row: int = 0) -> None:
        """Overwrite rows from `first_row` on with host values of the same row shape."""
        values = np.ascontiguousarray(values, self.dtype)
        if values.shape[1:] != self.shape[1:] or first_row + len(values) > self.shape[0]:
            raise ShapeError(f"cannot write {values.shape} at row {first_row} of {self.shape}")
        if values.size:
            stride = math.prod(self.shape[1:]) * self.dtype.itemsize
            self.device.note_wait()
            cl.enqueue_copy(self.device.queue, self.buffer, values, dst_offset=first_row * stride, is_blocking=True)

    def fill(self, value: float = 0) -> None:
        """Set every element to `value`."""
        if self.nbytes:
            self.device.fill(self, value)


class Reading:
    """A copy of an Array's values at one point of the queue, which is on its way to the host: to
    begin it does not wait."""

    def __init__(self, array: Array) -> None:
        self._host: NDArray[Any] = np.empty(array.shape, array.dtype)
        self._event = cl.enqueue_copy(array.device.queue, self._host, array.buffer, is_blocking=False)
        array.device.queue.flush()

    def values(self) -> NDArray[Any]:
        """The values; waits until they are there."""
        self._event.wait()
        return self._host


class Writing:
    """Host values on their way into an Array: to begin it does not wait. The values, as of
    `pinned`, must not change before `wait` returns."""

    def __init__(self, array: Array, host: NDArray[Any]) -> None:
        if host.shape != array.shape or host.dtype != array.dtype:
            raise ShapeError(f"cannot write {host.shape} of {host.dtype} into {array.shape} of {array.dtype}")
        self._host = host
        self._event = cl.enqueue_copy(array.device.queue, array.buffer, host, is_blocking=False)

    def wait(self) -> None:
        """Wait until the values are no longer needed."""
        self._event.wait()


class Transfers:
    """A second queue of a device, in which rows travel one after another, beside the kernels."""

    def __init__(self, device: Device) -> None:
        self._kernels, self._queue = device.queue, cl.CommandQueue(device.context, device.handle)

    def follow_kernels(self) -> None:
        """Let all that travels from now on wait for the end of the kernels so far."""
        cl.enqueue_barrier(self._queue, wait_for=[cl.enqueue_marker(self._kernels)])
        self._kernels.flush()

    def lead_kernels(self) -> None:
        """Let all kernels that follow wait for what is on its way."""
        cl.enqueue_barrier(self._kernels, wait_for=[cl.enqueue_marker(self._queue)])
        self._queue.flush()

    def read(self, array: Array, first: int, host: NDArray[Any]) -> None:
        """Begin to copy rows of an array, from `first` on, to the host."""
        cl.enqueue_copy(
            self._queue, host, array.buffer, is_blocking=False, src_offset=first * array.nbytes // len(array)
        )

    def write(self, array: Array, first: int, host: NDArray[Any]) -> None:
        """Begin to overwrite rows, from `first` on, with values that stay till that is done."""
        cl.enqueue_copy(
            self._queue, array.buffer, host, is_blocking=False, dst_offset=first * array.nbytes // len(array)
        )

    def finish(self) -> None:
        """Wait for all that is on its way."""
        self._queue.finish()


def pinned(device: Device, shape: tuple[int, ...]) -> NDArray[np.uint32]:
    """uint32 in host memory that a device reads and writes at full speed, as it is never paged out;
    in any, where there is too little of that."""
    flags: Any = cl.mem_flags.READ_WRITE | cl.mem_flags.ALLOC_HOST_PTR
    try:
        buffer = cl.Buffer(device.context, flags, max(1, 4 * math.prod(shape)))
    except (cl.MemoryError, cl.RuntimeError):
        return np.zeros(shape, np.uint32)
    mode: Any = cl.map_flags.READ | cl.map_flags.WRITE
    dtype: Any = np.uint32
    host: Any = cl.enqueue_map_buffer(device.queue, buffer, mode, 0, shape, dtype)[0]
    mapped: NDArray[np.uint32] = host  # which keeps the buffer
    return mapped


class Block:
    """A block of device memory.

    Its buffer may be kept by recorded launches (graph.py); the block can be taken again all the
    same.

    Parameters
    ----------
    give_back : is called with the buffer when nothing refers to the block any more.
    """

    __slots__ = ("buffer", "_give_back")

    def __init__(self, buffer: Any, give_back: Callable[[Any], None]) -> None:
        self.buffer, self._give_back = buffer, give_back

    def __del__(self) -> None:
        self._give_back(self.buffer)


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
        fits = [
            other
            for other, free in self._free.items()
            if free and size <= other <= (MOST_SPARE * size if exact else size)
        ]
        if fits:
            free = self._free[min(fits)]
            return Block(free.pop(), free.append)
        buffer = self._allocate(size)
        self.managed_bytes += size
        return Block(buffer, self._free.setdefault(size, []).append)

    def free_held(self) -> None:
        """Give back the memory of all blocks that are not in use."""
        for size, free in self._free.items():
            self.managed_bytes -= size * len(free)
            free.clear()


def block_bytes(size: int) -> int:
    """The size of a block for `size` bytes: four sizes an octave, as these change with views."""
    unit = 1 << max(0, size.bit_length() - 3)  # a quarter of the leading bit
    return -(-size // unit) * unit
