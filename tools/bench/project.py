"""Cull, project and the adjoint of project, all harmonics active."""

from clsplat.render.blend import blend_adjoint, blend_defines
from clsplat.render.project import cull, project, project_adjoint

from .measure import arguments, milliseconds, open_device, report
from .workloads import CityFrame

DEFINES = (("SH_REST", 15), ("ANTIALIASED", 0))


def main(argv):
    options = arguments(argv, __doc__, gaussians=200_000)
    device = open_device(options)
    city = CityFrame(device, options.gaussians)
    rows, camera, frame = city.rows, city.camera, city.frame
    renderer, visible = city.renderer, frame.visible
    sums = blend_adjoint(
        device, frame.splats, frame.pairs, frame.blended, renderer.background, frame.image,
        device.zeros((1, 1)), blend_defines(device, with_depth=False, smooth_cutoff=False))
    cases = {
        "cull": lambda: cull(device, rows, camera, DEFINES),
        "project": lambda: project(device, rows, visible, camera, 3, DEFINES),
        "adjoint": lambda: project_adjoint(
            device, rows, visible, camera, 3, DEFINES, sums, renderer.skipped)}
    for case, function in cases.items():
        times = milliseconds(device, function, options.repeats)
        report(options, device, "project", case, times, gaussians=options.gaussians,
               visible=len(visible))
