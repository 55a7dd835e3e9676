"""Blending a frame's splats, and the adjoint by pair of tile and splat."""

from collections.abc import Callable
from functools import partial

from clsplat.rendering.blend import blend, blend_adjoint, blend_defines

from .measure import Bench
from .workloads import CityFrame

FORWARD_OPERATIONS, ADJOINT_OPERATIONS = 39, 62  # a pixel and splat blended


def main(argv: list[str]) -> None:
    """Run this benchmark with its flags."""
    bench = Bench(argv, __doc__, gaussians="200k", depth=False)
    device, depth = bench.device, bench.options.depth
    defines = blend_defines(depth)
    for count in bench.options.gaussians:
        city = CityFrame(device, count)
        frame, background = city.frame, city.renderer.background
        splats, pairs, (width, height) = frame.splats, city.pairs, frame.size
        blended = blend(device, splats, pairs, width, height, background, defines)
        cases: dict[str, Callable[[], object]] = {
            "forward": partial(blend, device, splats, pairs, width, height, background, defines),
            # any gradients will do: their values do not change the work
            "adjoint": partial(blend_adjoint, device, splats, pairs, blended, background,
                               blended.image, blended.depth, blended.depth, defines)}
        real, blended_pixels = device.real.itemsize, city.blended_pixels()
        # the group form's states of every bucket, written and read
        states = 0 if blended.checkpoints is None else blended.checkpoints.nbytes
        traffic = {
            "forward": pairs.count * (4 + 12 * real) + width * height * (4 * real + 4) + states,
            "adjoint": pairs.count * (8 + 21 * real) + width * height * (4 * real + 4) + states}
        size = {**city.size, "blended_pixels": blended_pixels}
        for case, function in cases.items():
            operations = blended_pixels * (
                FORWARD_OPERATIONS if case == "forward" else ADJOINT_OPERATIONS)
            bench.report("blend", case + " with depth" * depth, bench.milliseconds(function), size,
                         traffic[case], operations)
