"""Stable sorts of a frame: visible gaussians by depth, and pairs by tile."""

from functools import partial

import numpy as np
from numpy.typing import NDArray

from clsplat.device import Device
from clsplat.primitives.gather import compact
from clsplat.primitives.sort import digits, stable_sort
from clsplat.rendering.bin import Pairs
from clsplat.rendering.project import cull

from .measure import Bench
from .project import DEFINES
from .workloads import CityFrame


def main(argv: list[str]) -> None:
    """Run this benchmark with its flags."""
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


def sort_work(device: Device, count: int, bits: int) -> tuple[int, int]:
    """The bytes and the operations of sorting `count` keys of `bits` bits."""
    passes, _ = digits(device, bits)
    # a pass reads keys twice and values, but for the first, and writes both; its digit is a shift
    # and a mask, twice, and counts up twice
    return count * (20 * passes - 4), 6 * count * passes


def pair_tiles(pairs: Pairs) -> NDArray[np.uint32]:
    """The tiles uint32[P] of the pairs, in the order before they were sorted."""
    begin, end = pairs.ranges.download().T
    tiles = np.empty(pairs.count, np.uint32)
    tiles[pairs.emission_indices.download()] = np.repeat(
        np.arange(len(begin), dtype=np.uint32), end - begin)
    return tiles


def tile_bits(pairs: Pairs) -> int:
    """The number of bits of a tile's number."""
    return len(pairs.ranges).bit_length()
