"""A view's colour transform, applied and stepped, at the size of a real photo."""

import numpy as np

from clsplat.loss.exposure import Exposures

from .measure import arguments, milliseconds, open_device, report


def main(argv):
    options = arguments(argv, __doc__, size=[1019, 766])
    device = open_device(options)
    width, height = options.size
    rng = np.random.default_rng(0)
    image = device.upload(rng.random((3, height, width)))
    grad = device.upload(rng.normal(size=image.shape))
    exposures = Exposures(device, 100)

    def both():
        exposures.apply(0, image)
        exposures.adjoint(0, image, grad)

    times = milliseconds(device, both, options.repeats)
    # the image is read twice, the gradient once; the result and its gradient are written
    report(options, device, "exposure", f"{width}x{height}", times, bytes=5 * image.nbytes)
