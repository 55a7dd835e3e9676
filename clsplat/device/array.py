"""Typed arrays in device memory."""

import math
from typing import Any, NamedTuple

import numpy as np
import pyopencl as cl

from clsplat.errors import ShapeError


class ArraySpec(NamedTuple):
    """An array that its owner allocates, and that estimates of memory count.

    Attributes
    ----------
    shape : of rows; the first axis counts them.
    dtype : None is the device's real.
    """

    shape: tuple[int, ...]
    dtype: Any = None

    def nbytes(self, real: np.dtype) -> int:
        """Bytes on a device whose real is `real`."""
        return math.prod(self.shape) * np.dtype(real if self.dtype is None else self.dtype).itemsize


class Array:
    """Device memory with a shape and a type; rows are contiguous and the first axis counts them."""

    __slots__ = ("device", "buffer", "shape", "dtype", "nbytes", "__weakref__")

    def __init__(self, device, buffer, shape, dtype):
        self.device, self.buffer = device, buffer
        self.shape, self.dtype = shape, np.dtype(dtype)
        self.nbytes = math.prod(shape) * self.dtype.itemsize

    def __len__(self):
        return self.shape[0]

    def narrow(self, rows):
        """The first `rows` rows: the same memory, no copy."""
        if rows > self.shape[0]:
            raise ShapeError(f"cannot narrow {self.shape} to {rows} rows")
        return Array(self.device, self.buffer, (rows, *self.shape[1:]), self.dtype)

    def reshaped(self, *shape):
        """The same memory under another shape of equal size."""
        if math.prod(shape) != math.prod(self.shape):
            raise ShapeError(f"cannot reshape {self.shape} to {shape}")
        return Array(self.device, self.buffer, tuple(shape), self.dtype)

    def download(self):
        """A numpy copy; waits for everything queued before."""
        host = np.empty(self.shape, self.dtype)
        if host.size:
            cl.enqueue_copy(self.device.queue, host, self.buffer)
        return host

    def last(self):
        """The last element, as a numpy scalar; waits like `download`."""
        host = np.empty(1, self.dtype)
        end = self.nbytes - self.dtype.itemsize
        cl.enqueue_copy(self.device.queue, host, self.buffer, src_offset=end)
        return host[0]

    def write(self, values, first_row=0):
        """Overwrite rows from `first_row` with host values of the same row shape."""
        values = np.ascontiguousarray(values, self.dtype)
        if values.shape[1:] != self.shape[1:] or first_row + len(values) > self.shape[0]:
            raise ShapeError(f"cannot write {values.shape} at row {first_row} of {self.shape}")
        if values.size:
            stride = math.prod(self.shape[1:]) * self.dtype.itemsize
            cl.enqueue_copy(self.device.queue, self.buffer, values, dst_offset=first_row * stride,
                            is_blocking=True)

    def fill(self, value=0):
        """Set every element; zero is the common case."""
        if self.nbytes:
            cl.enqueue_fill_buffer(
                self.device.queue, self.buffer, self.dtype.type(value), 0, self.nbytes)
