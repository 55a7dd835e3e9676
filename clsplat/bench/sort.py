"""Stable sorts of a frame: visible gaussians by depth, and pairs by tile."""

from functools import partial

import numpy as np

from clsplat.primitives.gather import compact
from clsplat.primitives.sort import digits, stable_sort
from clsplat.rendering.project import cull

from .measure import Bench
from .project import DEFINES
from .workloads import CityFrame


def main(argv):
    bench = Bench(argv, __doc__, gaussians="200k")
    device = bench.device
    for count in bench.options.gaussians:
        city = CityFrame(device, count)
        depths, _ = compact(device, *cull(device, city.rows, city.camera, DEFINES))
        pairs = city.frame.pairs
        tiles = device.upload(pair_tiles(pairs))
        cases = (("depths", depths, 32), ("pairs by tile", tiles, tile_bits(pairs)))
        for case, keys, bits in cases:
            times = bench.milliseconds(partial(stable_sort, device, keys, bits=bits))
            bench.report("sort", case, times, {"gaussians": count, "keys": len(keys), "bits": bits},
                         *sort_work(device, len(keys), bits))


def sort_work(device, count, bits):
    """(bytes, operations) of sorting `count` keys of so many bits."""
    passes, _ = digits(device, bits)
    # a pass reads keys twice and values, but for the first, and writes both; its digit is a shift
    # and a mask, twice, and counts up twice
    return count * (20 * passes - 4), 6 * count * passes


def pair_tiles(pairs):
    """uint32[P]: the tiles of the pairs as they were emitted, from the sorted ones."""
    begin, end = pairs.ranges.download().T
    tiles = np.empty(pairs.count, np.uint32)
    tiles[pairs.emission_indices.download()] = np.repeat(
        np.arange(len(begin), dtype=np.uint32), end - begin)
    return tiles


def tile_bits(pairs):
    return len(pairs.ranges).bit_length()
