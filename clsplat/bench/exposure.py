"""The adjoint of a view's response and its step, at the size of a real photo."""

import numpy as np

from clsplat.camera import Camera
from clsplat.loss.exposure import Exposures
from clsplat.primitives.compact import new_counts
from clsplat.rendering.project import pack_camera
from clsplat.response import Lenses

from .measure import Bench

# a pixel takes a transposed matrix of 3 x 3 and twelve sums of products; with vignetting, the
# squared radius, the gain and its products, and three sums more; with a tone curve, four bends of
# each channel and their derivatives
OPERATIONS = {"": 36, "vignetting": 66, "tone": 250}


def main(argv: list[str]) -> None:
    """Run this benchmark with its flags."""
    bench = Bench(argv, __doc__, size=[1019, 766])
    device, (width, height) = bench.device, bench.options.size
    rng = np.random.default_rng(0)
    image = device.upload(rng.random((3, height, width)))
    grad, counts = device.upload(rng.normal(size=image.shape)), new_counts(device)
    camera = Camera(width, height, (width, width), (width / 2, height / 2), np.eye(3), np.zeros(3))
    packed, views = pack_camera(device, camera, 0.01), 100
    for part, operations in OPERATIONS.items():
        exposures = Exposures(device, views, lenses=Lenses.of_cameras(views * [camera]),
                              vignetting=part == "vignetting", tone=part == "tone")

        def both(exposures: Exposures = exposures) -> None:
            exposures.step(0, exposures.adjoint(0, packed, image, grad)[1], counts)

        # the image and the gradient are read, the gradient by the image is written
        bench.report("exposure", "adjoint and step" + f" with {part}" * bool(part),
                     bench.milliseconds(both), {"width": width, "height": height},
                     3 * image.nbytes, operations * width * height)
