"""Reprojection of a rendered depth into a source view, at the size of a real photo."""

import numpy as np

from clsplat.device import Array
from clsplat.loss.reproject import pack_pairs, reproject

from .measure import Bench
from .workloads import ring_camera


def main(argv: list[str]) -> None:
    """Run this benchmark with its flags."""
    bench = Bench(argv, __doc__, size=[1019, 766])
    device, (width, height) = bench.device, bench.options.size
    rng = np.random.default_rng(0)
    photo, neighbour = (device.upload(rng.integers(0, 256, (3, height, width), np.uint8))
                        for _ in range(2))
    # about as far as the middle of the city
    depth = device.upload(0.75 * rng.normal(125, 3, (height, width)))
    transmittance = device.upload(np.full((height, width), 0.25))
    geometries = pack_pairs(device, [(ring_camera(0, (width, height)),
                                      ring_camera(0.1, (width, height)))])
    colours = device.upload(np.eye(3, 4).reshape(1, 12))

    def run() -> tuple[Array, ...]:
        return reproject(device, depth, transmittance, photo, neighbour, geometries, colours, 0,
                         1.0)

    times = bench.milliseconds(run)
    valid = run()[0].last()
    # depth and transmittance read, two gradients written, read and written; both photos read. A
    # pixel is turned into the other camera and compared in three channels, each between four
    # others, with the derivatives by depth
    bench.report("reproject", "value and gradient", times,
                 {"width": width, "height": height, "valid": int(valid)},
                 (2 + 2 * 3) * depth.nbytes + 2 * photo.nbytes, 160 * width * height)
