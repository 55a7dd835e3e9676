"""Rows by index (cl/gather.cl)."""

import math

from clsplat.device import Array, Device, Kernel, each

GATHER = Kernel("gather.cl", "gather", each("count width"), count="uint", width="uint",
                indices=("uint", "N"), rows=("real", "M", "W"), result=("real", "N", "W"))


def gather(device: Device, rows: Array, indices: Array, result: Array | None = None) -> Array:
    """Copy rows: result[i] = rows[indices[i]].

    Parameters
    ----------
    rows : real[M, ...]
    indices : uint[N]
    result : real[at least N, ...], to write into; None makes a new array.
    """
    count = len(indices)
    if result is None:
        result = device.empty((count, *rows.shape[1:]))
    width = math.prod(rows.shape[1:])
    if width:
        device.launch(GATHER, count=count, width=width, indices=indices,
                      rows=rows.reshaped(len(rows), width),
                      result=result.narrow(count).reshaped(count, width))
    return result
