"""Stable sorts of a frame: visible gaussians by depth, and pairs by tile."""

import numpy as np

from clsplat.primitives.gather import compact
from clsplat.primitives.sort import stable_sort
from clsplat.render.project import cull

from .measure import arguments, milliseconds, open_device, report
from .project import DEFINES
from .workloads import CityFrame


def main(argv):
    options = arguments(argv, __doc__, gaussians=200_000)
    device = open_device(options)
    city = CityFrame(device, options.gaussians)
    depths, _ = compact(device, *cull(device, city.rows, city.camera, DEFINES))
    times = milliseconds(device, lambda: stable_sort(device, depths), options.repeats)
    report(options, device, "sort", "depths", times, keys=len(depths), bits=32)
    tiles, bits = device.upload(pair_tiles(city.frame.pairs)), bits_of(city.frame.pairs)
    times = milliseconds(device, lambda: stable_sort(device, tiles, bits=bits), options.repeats)
    report(options, device, "sort", "pairs by tile", times, keys=len(tiles), bits=bits)


def pair_tiles(pairs):
    """uint32[P]: the tiles of the pairs as they were emitted, from the sorted ones."""
    begin, end = pairs.ranges.download().T
    tiles = np.empty(pairs.count, np.uint32)
    tiles[pairs.slots.download()] = np.repeat(np.arange(len(begin), dtype=np.uint32), end - begin)
    return tiles


def bits_of(pairs):
    return len(pairs.ranges).bit_length()
