"""Project and its adjoint, all spherical harmonics active."""

from collections.abc import Callable
from functools import partial

from clsplat.rendering.blend import blend_adjoint, blend_defines
from clsplat.rendering.project import project, project_adjoint

from .cull import DEFINES
from .measure import Bench
from .workloads import CityFrame

PARAMETERS = 59  # reals of a gaussian of degree 3
PROJECT_OPERATIONS, ADJOINT_OPERATIONS = 330, 700  # a gaussian


def main(argv: list[str]) -> None:
    """Run this benchmark with its flags."""
    bench = Bench(argv, __doc__, gaussians="200k")
    device, real = bench.device, bench.device.real.itemsize
    for count in bench.options.gaussians:
        city = CityFrame(device, count)
        rows, camera, frame, renderer = city.rows, city.camera, city.frame, city.renderer
        visible, pairs = frame.visible, city.pairs
        seen = len(visible)
        splat_grads = blend_adjoint(
            device, frame.splats, pairs, frame.blended, renderer.background, frame.image,
            device.zeros((1, 1)), device.zeros((1, 1)),
            blend_defines(with_depth=False))
        inputs = device, rows, visible, frame.counts, camera, 3, DEFINES
        # function, bytes, operations
        cases: dict[str, tuple[Callable[[], object], int, int]] = {
            "project": (partial(project, *inputs), seen * (8 + (PARAMETERS + 12) * real),
                        seen * PROJECT_OPERATIONS),
            # parameters, gradients (those of the harmonics as 6 numbers) and the mean's, nine
            # gradients of each pair, four indices
            "adjoint": (partial(project_adjoint, *inputs, splat_grads, renderer.skipped),
                        seen * (16 + (PARAMETERS + 19) * real) + pairs.count * 9 * real,
                        seen * ADJOINT_OPERATIONS)}
        for case, (function, traffic, operations) in cases.items():
            bench.report("project", case, bench.milliseconds(function),
                         {"gaussians": count, "visible": seen}, traffic, operations)
