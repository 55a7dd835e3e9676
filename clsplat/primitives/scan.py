"""Exclusive prefix sums (cl/scan.cl)."""

import numpy as np

from clsplat.device import Kernel

REDUCE = Kernel("scan.cl", "scan_reduce", count="uint", chunk="uint", values=("uint", "N"),
                totals=("ulong", "T"))
APPLY = Kernel("scan.cl", "scan_apply", count="uint", chunk="uint", values=("uint", "N"),
               totals=("ulong", "T"), offsets=("uint", "N"))

PER_ITEM = 8  # of the group form; scan.cl has the same
SMALLEST_CHUNK = 4096  # of the item form: below this a second thread costs more than it brings


def group_defines(device):
    """The work-group size, as the group form wants it."""
    return (("GROUP", device.scan_group),)


def chunk_size(device, count):
    """Elements a chunk: enough chunks for every core, or a fixed number a group."""
    if device.form == "group":
        return device.scan_group * PER_ITEM
    return max(SMALLEST_CHUNK, -(-count // (2 * device.compute_units)))


def exclusive_scan(device, values):
    """(offsets uint[N], totals ulong[chunks + 1]) of uint[N]; totals[-1] is the sum, in 64 bits."""
    count = len(values)
    offsets = device.empty(count, np.uint32)
    if count == 0:
        return offsets, device.zeros(1, np.uint64)
    chunk = chunk_size(device, count)
    chunks = -(-count // chunk)
    totals = device.empty(chunks + 1, np.uint64)
    item = device.form == "item"
    group = 1 if item else device.scan_group
    defines = group_defines(device)
    items = chunks * group
    device.launch(REDUCE, items, group, defines, count=count, chunk=chunk, values=values,
                  totals=totals)
    device.launch(APPLY, items, group, defines, count=count, chunk=chunk, values=values,
                  totals=totals, offsets=offsets)
    return offsets, totals
