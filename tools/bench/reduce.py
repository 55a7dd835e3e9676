"""Column sums: of an image loss's partial sums, and of a column a gaussian."""

from functools import partial

import numpy as np

from clsplat.primitives.reduce import sum_columns

from .measure import arguments, milliseconds, open_device, report


def main(argv):
    options = arguments(argv, __doc__, gaussians=200_000)
    device = open_device(options)
    rng = np.random.default_rng(0)
    # 3 channels of 1019 x 766 pixels in tiles of 16 x 16
    for case, shape in (("loss", (3 * 64 * 48, 2)), ("gaussians", (options.gaussians, 1))):
        rows = device.upload(rng.random(shape))
        times = milliseconds(device, partial(sum_columns, device, rows), options.repeats)
        report(options, device, "reduce", case, times, rows=shape[0], bytes=rows.nbytes)
