"""Blending a frame's splats, and the adjoint with its sums by splat."""

from clsplat.rendering.blend import blend, blend_adjoint, blend_defines

from .measure import Bench
from .workloads import CityFrame

FORWARD, ADJOINT = 39, 62  # operations a pixel and splat blended


def main(argv):
    bench = Bench(argv, __doc__, gaussians="200k", depth=False)
    device, depth = bench.device, bench.options.depth
    defines = blend_defines(depth)
    for count in bench.options.gaussians:
        city = CityFrame(device, count)
        frame, background = city.frame, city.renderer.background
        splats, pairs, (width, height) = frame.splats, frame.pairs, frame.size
        blended = blend(device, splats, pairs, width, height, background, defines)
        # any gradient will do: what it holds does not change the work
        inputs = device, splats, pairs, blended, background, blended.image, blended.depth
        cases = {
            "forward": lambda s=splats, p=pairs, w=width, h=height, b=background: blend(
                device, s, p, w, h, b, defines),
            "adjoint": lambda i=inputs: blend_adjoint(*i, i[-1], defines)}
        real, blended_pixels = device.real.itemsize, city.blended_pixels()
        # the group form's states of every bucket, written and read
        states = 0 if blended.checkpoints is None else blended.checkpoints.nbytes
        traffic = {
            "forward": pairs.count * (4 + 12 * real) + width * height * (4 * real + 4) + states,
            # the sums of a pair are written, and read to be added up
            "adjoint": pairs.count * (8 + 30 * real) + width * height * (4 * real + 4)
            + len(splats) * 9 * real + states}
        size = {**city.size, "blended_pixels": blended_pixels}
        for case, function in cases.items():
            operations = blended_pixels * (FORWARD if case == "forward" else ADJOINT)
            bench.report("blend", case + " with depth" * depth, bench.milliseconds(function), size,
                         traffic[case], operations)
