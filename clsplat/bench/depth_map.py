"""A rendered depth against a depth map, at the size of a real photo."""

import numpy as np

from clsplat.device import Array
from clsplat.loss.depth_map import compare_depth

from .measure import Bench


def main(argv: list[str]) -> None:
    """Run this benchmark with its flags."""
    bench = Bench(argv, __doc__, size=[1019, 766])
    device, (width, height) = bench.device, bench.options.size
    known = np.random.default_rng(0).normal(125, 3, (height, width))
    depth, transmittance, depths = (device.upload(values) for values in (
        0.75 * known, np.full(known.shape, 0.25), known * 1.02))

    def run() -> tuple[Array, ...]:
        return compare_depth(device, depth, transmittance, depths, 1.0)

    # three planes read, two gradients written
    bench.report("depth_map", "value and gradient", bench.milliseconds(run),
                 {"width": width, "height": height}, 5 * depth.nbytes, 20 * width * height)
