"""A device on which nothing runs and nothing is stored: what is asked of its memory is counted.

The code that trains runs on it as it is, so the count follows whatever that code allocates and for
how long it holds it.
"""

import numpy as np

from clsplat.device import Array, Device
from clsplat.device.device import Held
from clsplat.primitives.gather import gather


class DryDevice(Device):
    """Stands in for an open Device, with its form, sizes and limits; `peak_bytes`: the most that
    `memory_bytes` was.

    visible, pairs: what a frame will find, to be set before each: splats, and pairs of tile and
    splat. Reading back any other array gives zeros.
    """

    def __init__(self, device):
        self.__dict__.update(device.__dict__)
        self._pool = DryPool()
        self._held = Held()
        self._latest = None  # function of the last kernel launched
        self.visible = self.pairs = self.peak_bytes = 0

    def _allocate(self, shape, dtype, allocate):
        array = super()._allocate(shape, dtype, allocate)
        return DryArray(self, array.buffer, array.shape, array.dtype)

    def empty(self, shape, dtype=None):
        array = super().empty(shape, dtype)
        self.peak_bytes = max(self.peak_bytes, self.memory_bytes)
        return array

    def hold(self, shape, dtype=None):
        array = self._allocate(shape, dtype, lambda size: object())
        self._held.add(array)
        self.peak_bytes = max(self.peak_bytes, self.memory_bytes)
        return array

    def upload(self, values, dtype=None):
        values = np.asarray(values)
        if dtype is None:
            dtype = self.real if values.dtype.kind == "f" else values.dtype
        return self.hold(values.shape, dtype)

    def launch(self, kernel, defines=(), /, **values):
        self._latest = kernel.function

    def answer(self):
        """What a scan's total is: of the flags of visible gaussians, or of counts of pairs."""
        return self.visible if self._latest == "compact" else self.pairs

    def finish(self):
        pass


class DryArray(Array):
    """The shape and the lifetime of an Array."""

    __slots__ = ()

    def narrow(self, rows):
        array = super().narrow(rows)
        return DryArray(self.device, array.buffer, array.shape, array.dtype)

    def reshaped(self, *shape):
        array = super().reshaped(*shape)
        return DryArray(self.device, array.buffer, array.shape, array.dtype)

    def download(self):
        return np.zeros(self.shape, self.dtype)

    def last(self):
        return self.dtype.type(self.device.answer())

    def write(self, values, first_row=0):
        pass

    def fill(self, value=0):
        pass


class DryAdam:
    """What `optimise.adam.NumpyAdam` asks of the device, without its moments and its arithmetic,
    which take the host gigabytes and minutes where the model is large."""

    def __init__(self, device, dense):
        self.device, self.dense, self.m, self.v = device, dense, {}, {}

    def step(self, rows, gradients, step, rates, used, frozen=None):
        count = len(rows["positions"]) if self.dense else len(gradients.rows)
        touched = self.device.hold((count,), np.uint32)
        latest = [None]  # lives until there is the next
        for name, floats in used.items():
            if floats and count:
                latest[0] = gather(self.device, rows[name], touched)

    def regrow(self, source, kept, capacity):
        pass


class DryPool:
    """pyopencl's MemoryPool with one leading bit a bin: blocks of 3/2 and 2 times a power of two,
    which are kept for the next that asks for one of its bin."""

    def __init__(self):
        self.managed_bytes = 0
        self._free = {}  # bytes of a block -> how many of them are free

    def allocate(self, size):
        """A Block; it goes back to the pool when nothing refers to it."""
        rounded = block_bytes(size)
        if self._free.get(rounded):
            self._free[rounded] -= 1
        else:
            self.managed_bytes += rounded
        return Block(self._free, rounded)

    def free_held(self):
        """Forget the blocks that nothing refers to."""
        self.managed_bytes -= sum(size * count for size, count in self._free.items())
        self._free.clear()


class Block:
    """A block of a pool that is in use."""

    def __init__(self, free, size):
        self._free, self._size = free, size

    def __del__(self):
        self._free[self._size] = self._free.get(self._size, 0) + 1


def block_bytes(size):
    """What the pool takes for `size` bytes: the largest size of its bin."""
    half = 1 << max(0, size.bit_length() - 2)  # half of the leading bit
    return (size // half + 1) * half - 1
