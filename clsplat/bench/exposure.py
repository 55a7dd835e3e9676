"""A view's colour transform, its adjoint and its step, at the size of a real photo."""

import numpy as np

from clsplat.loss.exposure import Exposures
from clsplat.primitives.compact import new_counts

from .measure import Bench


def main(argv: list[str]) -> None:
    """Run this benchmark with its flags."""
    bench = Bench(argv, __doc__, size=[1019, 766])
    device, (width, height) = bench.device, bench.options.size
    rng = np.random.default_rng(0)
    image = device.upload(rng.random((3, height, width)))
    grad = device.upload(rng.normal(size=image.shape))
    exposures, counts = Exposures(device, 100), new_counts(device)

    def both() -> None:
        exposures.apply(0, image)
        exposures.step(0, exposures.adjoint(0, image, grad)[1], counts)

    # the image is read twice, the gradient once; the result and its gradient are written. A pixel
    # goes through a matrix of 3 x 4, its transpose, and twelve sums of products
    bench.report("exposure", "apply and adjoint", bench.milliseconds(both),
                 {"width": width, "height": height}, 5 * image.nbytes, 57 * width * height)
