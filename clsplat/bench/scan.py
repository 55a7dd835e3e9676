"""Exclusive scan of the pair counts of a frame's splats."""

from functools import partial

from clsplat.primitives.scan import exclusive_scan

from .measure import Bench
from .workloads import CityFrame


def main(argv: list[str]) -> None:
    """Run this benchmark with its flags."""
    bench = Bench(argv, __doc__, gaussians="200k")
    for count in bench.options.gaussians:
        counts = CityFrame(bench.device, count).frame.pairs.counts
        times = bench.milliseconds(partial(exclusive_scan, bench.device, counts))
        # values are read and added twice, offsets written once
        bench.report("scan", "pair counts", times, {"gaussians": count, "values": len(counts)},
                     3 * counts.nbytes, 2 * len(counts))
