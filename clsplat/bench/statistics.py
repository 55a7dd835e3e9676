"""Screen gradients of a frame, summed by gaussian."""

from functools import partial

from clsplat.densify.statistics import Statistics

from .measure import Bench
from .workloads import CityFrame


def main(argv: list[str]) -> None:
    """Run this benchmark with its flags."""
    bench = Bench(argv, __doc__, gaussians="200k")
    for count in bench.options.gaussians:
        city = CityFrame(bench.device, count)
        gradients, statistics = city.gradients(), Statistics(bench.device, count)
        times = bench.milliseconds(partial(statistics.accumulate, gradients, *city.frame.size))
        seen = len(gradients.rows)
        # a row number and two reals are read, a sum and a counter read and written; the length
        # takes two products, a sum and a root
        bench.report("statistics", "accumulate", times, {"gaussians": count, "visible": seen},
                     seen * (12 + 4 * bench.device.real.itemsize), 8 * seen)
