"""Stable radix sort of 32-bit keys (cl/sort.cl)."""

import numpy as np

from clsplat.device import Forms, Kernel, groups, items
from clsplat.primitives.scan import chunk_size, exclusive_scan

_CHUNKS = Forms(item=items("chunks"), group=groups("chunks", "SCAN_GROUP"))
_SIZES = dict(count="uint", chunk="uint", chunks="uint", shift="uint")
COUNT = Kernel("sort.cl", "sort_count", _CHUNKS, **_SIZES, keys=("uint", "N"), table=("uint", "T"))
SCATTER = Kernel("sort.cl", "sort_scatter", _CHUNKS, **_SIZES, first="uint", keys=("uint", "N"),
                 values=("uint", "N"), table=("uint", "T"), sorted_keys=("uint", "N"),
                 sorted_values=("uint", "N"))

# Bits a pass: a CPU's chunk keeps its counters in cache, a group in local memory
LARGEST_DIGIT = Forms(item=13, group=8)


def digits(device, bits):
    """(passes, bits a pass) of a sort by so many bits."""
    passes = max(1, -(-bits // LARGEST_DIGIT.of(device)))
    return passes, -(-bits // passes)


def stable_sort(device, keys, bits=32):
    """(sorted keys, permutation), both uint[N]: sorted[i] = keys[permutation[i]]; equal keys keep
    their order.

    bits: the keys' significant bits; higher ones must be zero.
    """
    count = len(keys)
    passes, digit_bits = digits(device, bits)
    chunk = chunk_size(device, count)
    chunks = max(1, -(-count // chunk))
    defines = (("DIGIT_BITS", digit_bits),)
    values = keys  # any array of the right size: the first pass does not read it
    table = device.empty(chunks << digit_bits, np.uint32)
    for index in range(passes):
        sorted_keys, sorted_values = (device.empty(count, np.uint32) for _ in range(2))
        sizes = dict(count=count, chunk=chunk, chunks=chunks, shift=index * digit_bits)
        device.launch(COUNT, defines, **sizes, keys=keys, table=table)
        places, _ = exclusive_scan(device, table)
        device.launch(SCATTER, defines, **sizes, first=int(index == 0), keys=keys, values=values,
                      table=places, sorted_keys=sorted_keys, sorted_values=sorted_values)
        keys, values = sorted_keys, sorted_values
    return keys, values
