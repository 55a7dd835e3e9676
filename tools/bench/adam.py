"""A whole step of Adam on the gradients of a frame, by engine, on its rows or on all."""

from functools import partial

from clsplat.gaussians import LEARNED
from clsplat.optimise.adam import DeviceAdam, NumpyAdam

from .measure import arguments, milliseconds, open_device, report
from .workloads import CityFrame

USED = {field.name: field.width(3) for field in LEARNED}
RATES = {field.name: field.rate for field in LEARNED}


def main(argv):
    options = arguments(argv, __doc__, gaussians=200_000)
    device = open_device(options)
    city = CityFrame(device, options.gaussians)
    gradients = city.gradients()
    for engine in (DeviceAdam, NumpyAdam):
        for dense in (False, True):
            adam = engine(device, city.rows, dense)
            times = milliseconds(
                device, partial(adam.step, city.rows, gradients, 1, RATES, USED),
                options.repeats, warm_up=1)
            changed = options.gaussians if dense else len(gradients.rows)
            # a parameter and two moments are read and written, the gradient is read
            floats = 6 * changed + len(gradients.rows)
            report(options, device, "adam", f"{engine.__name__} {'dense' if dense else 'sparse'}",
                   times, rows=changed, bytes=floats * sum(USED.values()) * device.real.itemsize)
