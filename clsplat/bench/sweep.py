"""A plane sweep of one photo over others, and the confirmation of its depths by these, at the size
at which trainings compare photos."""

import numpy as np

from clsplat.camera import Camera
from clsplat.device import Array
from clsplat.stereo.dense_points import PLANES, SAME_DEPTH, SOURCES
from clsplat.stereo.sweep import confirm, device_images, sweep

from .measure import Bench

COARSE, FINE = 16, 7 * 49  # pixels of a window in a plane of the sweep, and in all finer planes
OPERATIONS = 30  # of a pixel of a window: its place, four pixels, three sums
CONFIRM_OPERATIONS = 25  # of a pixel in a source: its place, and the comparison


def main(argv: list[str]) -> None:
    """Run this benchmark with its flags."""
    bench = Bench(argv, __doc__, size=[256, 192], planes=PLANES)
    device, (width, height) = bench.device, bench.options.size
    photos = list(np.random.default_rng(0).uniform(0, 1, (1 + SOURCES, height, width)))
    cameras = [Camera(width, height, (width, width), (width / 2, height / 2), np.eye(3),
                      np.array([-0.1 * number, 0, 0])) for number in range(len(photos))]
    images, sizes = device_images(device, photos)

    def run() -> tuple[Array, Array]:
        return sweep(images, sizes, cameras, 0, range(1, len(photos)), (0.1, 1.0),
                     bench.options.planes)

    windows = COARSE * bench.options.planes + FINE
    bench.report("sweep", f"{SOURCES} sources", bench.milliseconds(run),
                 {"width": width, "height": height, "planes": bench.options.planes},
                 images.nbytes + 2 * width * height * device.real.itemsize,
                 OPERATIONS * windows * SOURCES * width * height)
    depths = device.upload(np.full(images.shape, 0.5))

    def run_confirm() -> Array:
        return confirm(depths, sizes, cameras, 0, range(1, len(photos)), SAME_DEPTH)

    bench.report("sweep", f"confirm, {SOURCES} sources", bench.milliseconds(run_confirm),
                 {"width": width, "height": height},
                 depths.nbytes + 4 * width * height, CONFIRM_OPERATIONS * SOURCES * width * height)
