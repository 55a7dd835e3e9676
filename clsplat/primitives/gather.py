"""Rows by index (cl/gather.cl)."""

import math

from clsplat.device import Array, Device, Either, Kernel, each
from clsplat.device.kernel import Defines

GATHER = Kernel("gather.cl", "gather", each("count width"), count="uint", width="uint",
                indices=("uint", "N"),
                rows=Either("BYTES", ("uchar", "M", "W"), ("real", "M", "W")),
                result=Either("BYTES", ("uchar", "N", "W"), ("real", "N", "W")))


def gather(device: Device, rows: Array, indices: Array, result: Array | None = None) -> Array:
    """Copy rows: result[i] = rows[indices[i]].

    Parameters
    ----------
    rows : real[M, ...], or of another type, as bytes.
    indices : uint[N]
    result : [at least N, ...] of the same type, to write into; None makes a new array.
    """
    count, width = len(indices), math.prod(rows.shape[1:])
    if result is None:
        result = device.empty((count, *rows.shape[1:]), rows.dtype)
    if width:
        source = rows.reshaped(len(rows), width)
        target = result.narrow(count).reshaped(count, width)
        defines: Defines = ()
        if rows.dtype != device.real:
            source, target, defines = source.as_bytes(), target.as_bytes(), (("BYTES", 1),)
        device.launch(GATHER, defines, count=count, width=source.shape[1], indices=indices,
                      rows=source, result=target)
    return result
