"""Stable radix sort of 32-bit keys (cl/sort.cl)."""

import numpy as np

from clsplat.constants import FRAME_COUNTS
from clsplat.device import Array, Device, Kernel, each

COUNT = Kernel(
    "sort.cl",
    "sort_count",
    each("parts"),
    parts="uint",
    shift="uint",
    counts=("uint", FRAME_COUNTS),
    keys=("uint", "R"),
    table=("uint", "C", "D"),
)
SCATTER = Kernel(
    "sort.cl",
    "sort_scatter",
    each("parts"),
    parts="uint",
    shift="uint",
    first="uint",
    counts=("uint", FRAME_COUNTS),
    keys=("uint", "R"),
    values=("uint", "R"),
    table=("uint", "C", "D"),
    sorted_keys=("uint", "R"),
    sorted_values=("uint", "R"),
)

DIGIT_BITS = 11  # of a pass: its counters fit a CPU's cache
SORT_DEFINES = (("DIGIT_BITS", DIGIT_BITS),)
KEY_BITS = 32
PARTS_A_CORE = 2
MOST_PARTS = 32  # each work-item reads the counters of all


def parts_of(device: Device) -> int:
    """The number of parts of the keys, each of which a work-item walks."""
    return min(MOST_PARTS, PARTS_A_CORE * device.compute_units)


def stable_sort(device: Device, keys: Array, counts: Array) -> tuple[Array, Array]:
    """Sort the first counts[COUNT_VISIBLE] of uint[R] keys, and keep the order of equal keys.

    Parameters
    ----------
    keys : uint[R].
    counts : uint[FRAME_COUNTS].

    Returns
    -------
    The sorted keys and the permutation, both uint[R]: sorted[i] = keys[permutation[i]].
    """
    parts, room = parts_of(device), len(keys)
    table = device.empty((parts, 1 << DIGIT_BITS), np.uint32)
    sizes = dict(parts=parts, counts=counts, table=table)
    values = keys  # any array of the right size: the first pass does not read it
    for shift in range(0, KEY_BITS, DIGIT_BITS):
        sorted_keys, sorted_values = (device.empty(room, np.uint32) for _ in range(2))
        device.launch(COUNT, SORT_DEFINES, **sizes, shift=shift, keys=keys)
        device.launch(
            SCATTER,
            SORT_DEFINES,
            **sizes,
            shift=shift,
            first=int(shift == 0),
            keys=keys,
            values=values,
            sorted_keys=sorted_keys,
            sorted_values=sorted_values,
        )
        keys, values = sorted_keys, sorted_values
    return keys, values
