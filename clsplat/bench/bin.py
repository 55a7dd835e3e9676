"""From splats to the pairs of every tile, with its scan and sort."""

from functools import partial

from clsplat.rendering.bin import bin_splats

from .measure import Bench
from .sort import sort_work, tile_bits
from .workloads import CityFrame


def main(argv: list[str]) -> None:
    """Run this benchmark with its flags."""
    bench = Bench(argv, __doc__, gaussians="200k")
    device = bench.device
    for count in bench.options.gaussians:
        city = CityFrame(device, count)
        splats, pairs = city.frame.splats, city.frame.pairs
        times = bench.milliseconds(
            partial(bin_splats, device, splats, pairs.order, *city.frame.size))
        traffic, operations = sort_work(device, pairs.count, tile_bits(pairs))
        # twice an index and 7 reals of a splat and a count, the scan's three; of a pair, its tile
        # and splat written, and three read and one written for the ranges
        traffic += len(splats) * (2 * (8 + 7 * device.real.itemsize) + 12) + pairs.count * 24
        # the ellipse, and columns of about as many rows of tiles as pairs, both twice
        operations += 2 * (20 * len(splats) + 30 * pairs.count)
        bench.report("bin", "splats to pairs", times, city.size, traffic, operations)
