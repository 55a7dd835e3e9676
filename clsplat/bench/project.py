"""Cull, project and the adjoint of project, all spherical harmonics active."""

from functools import partial

from clsplat.rendering.blend import blend_adjoint, blend_defines
from clsplat.rendering.project import cull, project, project_adjoint

from .measure import Bench
from .workloads import CityFrame

DEFINES = (("SH_REST", 15), ("ANTIALIASED", 0))
PARAMETERS = 59  # reals of a gaussian of degree 3
# a gaussian; the early part of culling is for all, the rest for those that are visible
EARLY_OPERATIONS, CULL_OPERATIONS, PROJECT_OPERATIONS, ADJOINT_OPERATIONS = 60, 180, 330, 700


def main(argv: list[str]) -> None:
    """Run this benchmark with its flags."""
    bench = Bench(argv, __doc__, gaussians="200k")
    device, real = bench.device, bench.device.real.itemsize
    for count in bench.options.gaussians:
        city = CityFrame(device, count)
        rows, camera, frame, renderer = city.rows, city.camera, city.frame, city.renderer
        visible = frame.visible
        seen = len(visible)
        sums = blend_adjoint(
            device, frame.splats, frame.pairs, frame.blended, renderer.background, frame.image,
            device.zeros((1, 1)), device.zeros((1, 1)),
            blend_defines(with_depth=False))
        inputs = device, rows, visible, camera, 3, DEFINES
        cases = {  # function, bytes, operations
            "cull": (partial(cull, device, rows, camera, DEFINES),
                     count * (6 * real + 8) + seen * 5 * real,
                     count * EARLY_OPERATIONS + seen * CULL_OPERATIONS),
            "project": (partial(project, *inputs), seen * (4 + (PARAMETERS + 12) * real),
                        seen * PROJECT_OPERATIONS),
            # parameters and their gradients, nine sums, the mean's gradient, two indices
            "adjoint": (partial(project_adjoint, *inputs, sums, renderer.skipped),
                        seen * (8 + (2 * PARAMETERS + 11) * real), seen * ADJOINT_OPERATIONS)}
        for case, (function, traffic, operations) in cases.items():
            bench.report("project", case, bench.milliseconds(function),
                         {"gaussians": count, "visible": seen}, traffic, operations)
