"""Blending a frame's splats, and the adjoint with its sums by splat."""

from clsplat.render.blend import blend, blend_adjoint, blend_defines

from .measure import arguments, milliseconds, open_device, report
from .workloads import CityFrame


def main(argv):
    options = arguments(argv, __doc__, gaussians=200_000, depth=False)
    device = open_device(options)
    city = CityFrame(device, options.gaussians)
    frame, background = city.frame, city.renderer.background
    splats, pairs, (width, height) = frame.splats, frame.pairs, frame.size
    defines = blend_defines(device, options.depth, smooth_cutoff=False)
    blended = blend(device, splats, pairs, width, height, background, defines)
    # any gradient will do: what it holds does not change the work
    grads = blended.image, blended.depth, blended.depth
    cases = {
        "forward": lambda: blend(device, splats, pairs, width, height, background, defines),
        "adjoint": lambda: blend_adjoint(
            device, splats, pairs, blended, background, *grads, defines)}
    for case, function in cases.items():
        times = milliseconds(device, function, options.repeats)
        report(options, device, "blend", case, times, splats=len(splats), pairs=pairs.count,
               pixels=width * height)
