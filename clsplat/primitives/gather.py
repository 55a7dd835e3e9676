"""Rows by index, and the rows a flag keeps (cl/gather.cl)."""

import numpy as np

from clsplat.device import Kernel, each
from clsplat.primitives.scan import exclusive_scan

GATHER = Kernel("gather.cl", "gather", each("count width"), count="uint", width="uint",
                indices=("uint", "N"), rows=("real", "M", "W"), result=("real", "N", "W"))
SCATTER = Kernel("gather.cl", "scatter", each("count width"), count="uint", width="uint",
                 indices=("uint", "N"), values=("real", "N", "W"), rows=("real", "M", "W"))
COMPACT = Kernel("gather.cl", "compact", each("count"), count="uint", flags=("uint", "N"),
                 offsets=("uint", "N"), keys=("uint", "N"), kept_keys=("uint", "N"),
                 kept=("uint", "N"))


def gather(device, rows, indices, result=None):
    """result[i] = rows[indices[i]] for real[M, ...] rows and uint[N] indices.

    result: an array of at least N rows to write into; without it a new one is made.
    """
    count = len(indices)
    if result is None:
        result = device.empty((count, *rows.shape[1:]))
    width = _width(rows)
    if width:
        device.launch(GATHER, count=count, width=width, indices=indices,
                      rows=rows.reshaped(len(rows), width),
                      result=result.narrow(count).reshaped(count, width))
    return result


def scatter(device, values, indices, rows):
    """rows[indices[i]] = values[i], in place, for distinct indices uint[N]."""
    count, width = len(indices), _width(rows)
    if width:
        device.launch(SCATTER, count=count, width=width, indices=indices,
                      values=values.reshaped(count, width), rows=rows.reshaped(len(rows), width))


def _width(rows):
    return int(np.prod(rows.shape[1:], dtype=np.int64))


def compact(device, flags, keys):
    """(keys, row numbers) of the rows whose flag is 1, in order: uint[K] each.

    Waits for the device: the number of rows kept decides every later size.
    """
    count = len(flags)
    offsets, totals = exclusive_scan(device, flags)
    kept_keys, kept = (device.empty(count, np.uint32) for _ in range(2))
    device.launch(COMPACT, count=count, flags=flags, offsets=offsets, keys=keys,
                  kept_keys=kept_keys, kept=kept)
    total = int(totals.last())
    return kept_keys.narrow(total), kept.narrow(total)
