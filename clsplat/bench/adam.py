"""A whole step of Adam on the gradients of a frame, by engine, on the visible rows or on all."""

from functools import partial

from clsplat.gaussians import LEARNED
from clsplat.optimise.adam import DeviceAdam
from clsplat.optimise.numpy_adam import NumpyAdam

from .measure import Bench
from .workloads import CityFrame

USED = {field.name: field.width(3) for field in LEARNED}
RATES = {field.name: field.rate for field in LEARNED}
OPERATIONS = 14  # a parameter


def main(argv: list[str]) -> None:
    """Run this benchmark with its flags."""
    bench = Bench(argv, __doc__, gaussians="200k")
    for count in bench.options.gaussians:
        city = CityFrame(bench.device, count)
        gradients = city.gradients()
        for engine in (DeviceAdam, NumpyAdam):
            for dense in (False, True):
                adam = engine(bench.device, city.rows, dense)
                times = bench.milliseconds(
                    partial(adam.step, city.rows, gradients, 1, RATES, USED), warm_up=1)
                changed = (count if dense else len(gradients.rows)) * sum(USED.values())
                # a parameter and two moments are read and written, the gradient is read
                reals = 6 * changed + len(gradients.rows) * sum(USED.values())
                bench.report(
                    "adam", f"{engine.__name__} {'dense' if dense else 'sparse'}", times,
                    {"gaussians": count, "visible": len(gradients.rows)},
                    reals * bench.device.real.itemsize, OPERATIONS * changed)
