"""From splats to the pairs of every tile, in depth order."""

from functools import partial

import numpy as np

from clsplat.rendering.bin import NEEDS_ORDER, bin_splats

from .measure import Bench
from .workloads import CityFrame

KEY_BYTES = 8  # of the group form's sort


def main(argv: list[str]) -> None:
    """Run this benchmark with its flags."""
    bench = Bench(argv, __doc__, gaussians="200k")
    device = bench.device
    for count in bench.options.gaussians:
        city = CityFrame(device, count)
        frame, pairs = city.frame, city.pairs
        splats, number = frame.splats, pairs.count
        times = bench.milliseconds(partial(bin_splats, device, splats, frame.counts, frame.order,
                                           *frame.size, room=number))
        # twice 7 reals of a splat and its count, and its offset; of a pair the splat and the
        # emission index are written
        traffic = len(splats) * (2 * (4 + 7 * device.real.itemsize) + 4) + number * 8
        # the ellipse, and columns of about as many rows of tiles as pairs, both twice
        operations = 2 * (20 * len(splats) + 30 * number)
        if NEEDS_ORDER.of(device):
            traffic += 2 * len(splats) * 4
        else:  # a key is written and read at both ends of the sort, a splat written and read once
            lengths = np.diff(pairs.ranges.download().astype(np.int64)).ravel()
            stages = np.ceil(np.log2(np.maximum(lengths, 1)))
            traffic += number * (4 * KEY_BYTES + 8)
            operations += int((lengths * stages * (stages + 1)).sum())  # two each comparison
        bench.report("bin", "splats to pairs", times, city.size, traffic, operations)
