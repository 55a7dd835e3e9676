"""From splats to the pairs of every tile, with its scan and sort."""

from clsplat.render.bin import bin_splats

from .measure import arguments, milliseconds, open_device, report
from .workloads import CityFrame


def main(argv):
    options = arguments(argv, __doc__, gaussians=200_000)
    device = open_device(options)
    frame = CityFrame(device, options.gaussians).frame
    order = frame.pairs.order
    times = milliseconds(
        device, lambda: bin_splats(device, frame.splats, order, *frame.size), options.repeats)
    report(options, device, "bin", "1024x768", times, splats=len(frame.splats),
           pairs=frame.pairs.count)
