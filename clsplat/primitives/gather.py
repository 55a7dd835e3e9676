"""Rows by index (cl/gather.cl)."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.device import Array, Device, Either, Kernel, each
from clsplat.device.kernel import Defines

CHUNK_ROWS = 1 << 18  # that are copied to the host together

GATHER = Kernel(
    "gather.cl",
    "gather",
    each("count width"),
    count="uint",
    width="uint",
    indices=("uint", "N"),
    rows=Either("BYTES", ("uchar", "M", "W"), ("real", "M", "W")),
    result=Either("BYTES", ("uchar", "N", "W"), ("real", "N", "W")),
)

SCATTER = Kernel(
    "gather.cl",
    "scatter",
    each("count width"),
    count="uint",
    width="uint",
    indices=("uint", "N"),
    rows=Either("BYTES", ("uchar", "N", "W"), ("real", "N", "W")),
    result=Either("BYTES", ("uchar", "M", "W"), ("real", "M", "W")),
)


def scatter(device: Device, rows: Array, indices: Array, result: Array) -> None:
    """Put rows in their places: result[indices[i]] = rows[i].

    Parameters
    ----------
    rows : real[N, ...]
    indices : uint[N], no number twice.
    result : real[M, ...]
    """
    count, width = len(indices), math.prod(rows.shape[1:])
    if width:
        device.launch(
            SCATTER,
            count=count,
            width=width,
            indices=indices,
            rows=rows.reshaped(count, width),
            result=result.reshaped(len(result), width),
        )


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
            source, target = source.viewed(np.uint8), target.viewed(np.uint8)
            defines = (("BYTES", 1),)
        device.launch(GATHER, defines, count=count, width=source.shape[1], indices=indices, rows=source, result=target)
    return result


def download_rows(device: Device, array: Array, rows: NDArray[np.integer] | None) -> NDArray[Any]:
    """Copy rows, int[K], or all if that is None, to the host; CHUNK_ROWS of them at a time, as the
    device may have no room for more."""
    if rows is None:
        return array.download()
    host = np.empty((len(rows), *array.shape[1:]), array.dtype)
    for first in range(0, len(rows), CHUNK_ROWS):
        chosen = device.upload(rows[first : first + CHUNK_ROWS].astype(np.uint32))
        host[first : first + CHUNK_ROWS] = gather(device, array, chosen).download()
    return host
