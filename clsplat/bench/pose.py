"""The corrected camera of a view and a step on its pose, by the gradients of many gaussians."""

import numpy as np

from clsplat.camera import Camera
from clsplat.constants import POSE_REALS
from clsplat.device import Array
from clsplat.optimise.pose import RATE, Poses
from clsplat.primitives.compact import new_counts
from clsplat.rendering.project import pack_camera

from .measure import Bench


def main(argv: list[str]) -> None:
    """Run this benchmark with its flags."""
    bench = Bench(argv, __doc__, gaussians="200k,1M")
    device = bench.device
    camera = Camera(1019, 766, (1000, 1000), (510, 383), np.eye(3), np.zeros(3))
    packed = pack_camera(device, camera, 0.01)
    poses = Poses(device, 100 * [camera], 1.0)
    for count in bench.options.gaussians:
        terms = device.upload(np.random.default_rng(0).normal(size=(count, POSE_REALS)))
        counts = new_counts(device, count)

        def both(terms: Array = terms, counts: Array = counts) -> None:
            poses.apply(0, packed)
            poses.step(0, RATE, packed, terms, counts)

        bench.report("pose", "camera and step", bench.milliseconds(both), {"gaussians": count},
                     terms.nbytes, POSE_REALS * count)
