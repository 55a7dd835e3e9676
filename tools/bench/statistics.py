"""Screen gradients of a frame, summed by gaussian."""

from clsplat.densify.statistics import Statistics

from .measure import arguments, milliseconds, open_device, report
from .workloads import CityFrame


def main(argv):
    options = arguments(argv, __doc__, gaussians=200_000)
    device = open_device(options)
    city = CityFrame(device, options.gaussians)
    gradients, statistics = city.gradients(), Statistics(device, options.gaussians)
    times = milliseconds(
        device, lambda: statistics.accumulate(gradients, *city.frame.size), options.repeats)
    # a row number and two floats are read, a sum and a counter read and written
    report(options, device, "statistics", "1024x768", times, rows=len(gradients.rows),
           bytes=(3 + 4) * 4 * len(gradients.rows))
