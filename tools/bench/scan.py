"""Exclusive scan of the pair counts of a frame's splats."""

from clsplat.primitives.scan import exclusive_scan

from .measure import arguments, milliseconds, open_device, report
from .workloads import CityFrame


def main(argv):
    options = arguments(argv, __doc__, gaussians=200_000)
    device = open_device(options)
    counts = CityFrame(device, options.gaussians).frame.pairs.counts
    times = milliseconds(device, lambda: exclusive_scan(device, counts), options.repeats)
    # values are read twice, offsets written once
    report(options, device, "scan", "pair counts", times, values=len(counts),
           bytes=3 * counts.nbytes)
