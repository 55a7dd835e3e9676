"""Regularisation of the opacities and sizes of the gaussians that a view sees."""

from functools import partial

from clsplat.loss.regularise import regularise

from .measure import Bench
from .workloads import CityFrame

REALS = 12  # a gaussian: opacity and scales, and their gradients read and written


def main(argv: list[str]) -> None:
    """Run this benchmark with its flags."""
    bench = Bench(argv, __doc__, gaussians="200k,1M")
    for count in bench.options.gaussians:
        city = CityFrame(bench.device, count)
        gradients = city.gradients()
        visible = len(gradients.rows)
        times = bench.milliseconds(partial(regularise, city.rows, gradients, 0.01, 0.01))
        bench.report("regularise", "of a view", times, {"gaussians": count, "visible": visible},
                     REALS * visible * bench.device.real.itemsize, 20 * visible)
