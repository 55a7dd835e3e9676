"""The adjoint of a frame with and without its screen gradients, summed by gaussian."""

from functools import partial

import numpy as np

from clsplat.densify.statistics import Statistics

from .measure import Bench
from .workloads import CityFrame


def main(argv: list[str]) -> None:
    """Run this benchmark with its flags."""
    bench = Bench(argv, __doc__, gaussians="200k")
    for count in bench.options.gaussians:
        city = CityFrame(bench.device, count)
        image, sums = city.frame.image, Statistics(bench.device, count).sums
        grad = bench.device.upload(np.full(image.shape, 1 / np.prod(image.shape)))
        seen = len(city.frame.visible)
        for name, statistics in (("with", sums), ("without", None)):
            times = bench.milliseconds(partial(city.renderer.adjoint, city.rows, city.frame, grad,
                                               statistics=statistics))
            bench.report("statistics", f"adjoint {name} statistics", times,
                         {"gaussians": count, "visible": seen})
