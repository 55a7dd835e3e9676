"""What each splat of a frame contributed to it."""

import numpy as np

from clsplat.densify.contribution import contribution

from .measure import arguments, milliseconds, open_device, report
from .workloads import CityFrame


def main(argv):
    options = arguments(argv, __doc__, gaussians=200_000)
    device = open_device(options)
    frame = CityFrame(device, options.gaussians).frame
    width, height = frame.size
    weights = device.upload(np.random.default_rng(0).random((height, width)))
    times = milliseconds(device, lambda: contribution(device, frame, weights), options.repeats)
    report(options, device, "contribution", f"{width}x{height}", times, splats=len(frame.splats),
           pairs=frame.pairs.count, pixels=width * height)
