"""Exclusive prefix sums (cl/scan.cl)."""

import numpy as np

from clsplat.constants import PER_ITEM
from clsplat.device import Array, Device, Forms, Kernel, groups, items

SMALLEST_CHUNK = 4096  # values, of the item form: a second thread costs more than it saves

_CHUNKS = Forms(item=items("count/chunk"), group=groups("count/chunk", "SCAN_GROUP"))
REDUCE = Kernel("scan.cl", "scan_reduce", _CHUNKS, count="uint", chunk="uint",
                values=("uint", "N"), totals=("ulong", "T"))
APPLY = Kernel("scan.cl", "scan_apply", _CHUNKS, count="uint", chunk="uint",
               values=("uint", "N"), totals=("ulong", "T"), offsets=("uint", "N"))


def chunk_size(device: Device, count: int) -> int:
    """Values in a chunk: enough chunks for every core, or a fixed number for a group."""
    return int(Forms(item=max(SMALLEST_CHUNK, -(-count // (2 * device.compute_units))),
                     group=device.scan_group * PER_ITEM).of(device))


def exclusive_scan(device: Device, values: Array) -> tuple[Array, Array]:
    """Exclusive prefix sums of uint[N].

    Returns
    -------
    The prefix sums uint[N], and the totals ulong[chunks + 1], whose last element is the sum.
    """
    count = len(values)
    offsets = device.empty(count, np.uint32)
    if count == 0:
        return offsets, device.zeros(1, np.uint64)
    chunk = chunk_size(device, count)
    chunks = -(-count // chunk)
    totals = device.empty(chunks + 1, np.uint64)
    shared = dict(count=count, chunk=chunk, values=values, totals=totals)
    device.launch(REDUCE, **shared)
    device.launch(APPLY, **shared, offsets=offsets)
    return offsets, totals
