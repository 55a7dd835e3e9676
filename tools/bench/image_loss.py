"""L1 and D-SSIM with the gradient, at the size of a real photo."""

import numpy as np

from clsplat.loss.image_loss import image_loss

from .measure import arguments, milliseconds, open_device, report


def main(argv):
    options = arguments(argv, __doc__, size=[1019, 766])
    device = open_device(options)
    width, height = options.size
    rng = np.random.default_rng(0)
    image = device.upload(rng.random((3, height, width)))
    photo = device.upload(rng.integers(0, 256, image.shape, np.uint8))
    times = milliseconds(device, lambda: image_loss(device, image, photo, 0.2), options.repeats)
    # image and photo are read twice, three maps written and read, the gradient written
    report(options, device, "image_loss", f"{width}x{height}", times,
           bytes=(2 + 6 + 1) * image.nbytes + 2 * photo.nbytes)
