"""L1 and D-SSIM with the gradient, at the size of a real photo."""

from functools import partial

import numpy as np

from clsplat.loss.image_loss import HAS_MAPS, image_loss

from .measure import Bench

# a value: 11 taps along both axes of four means and of three maps, SSIM and its gradients
OPERATIONS = 2 * 2 * 11 * (4 + 3) + 60


def main(argv: list[str]) -> None:
    """Run this benchmark with its flags."""
    bench = Bench(argv, __doc__, size=[1019, 766])
    device, (width, height) = bench.device, bench.options.size
    rng = np.random.default_rng(0)
    image = device.upload(rng.random((3, height, width)))
    photo = device.upload(rng.integers(0, 256, image.shape, np.uint8))
    times = bench.milliseconds(partial(image_loss, device, image, photo, 0.2))
    # image and photo are read twice and the gradient is written; in the group form, three maps are
    # written and read
    maps = 6 * HAS_MAPS.of(device)
    bench.report("image_loss", "value and gradient", times, {"width": width, "height": height},
                 (2 + maps + 1) * image.nbytes + 2 * photo.nbytes, OPERATIONS * 3 * width * height)
