"""Culling: which gaussians a view sees."""

from functools import partial

from clsplat.rendering.cull import cull

from .measure import Bench
from .workloads import CityFrame

DEFINES = (("SH_REST", 15), ("ANTIALIASED", 0))
EARLY_OPERATIONS, OPERATIONS = 60, 180  # a gaussian; the second of those that are visible


def main(argv: list[str]) -> None:
    """Run this benchmark with its flags."""
    bench = Bench(argv, __doc__, gaussians="200k")
    device, real = bench.device, bench.device.real.itemsize
    for count in bench.options.gaussians:
        city = CityFrame(device, count)
        seen = len(city.frame.visible)
        times = bench.milliseconds(partial(cull, device, city.rows, city.camera, DEFINES))
        # position, scales and a flag; of those that are visible the rotation and opacity too
        bench.report("cull", "all gaussians", times, {"gaussians": count, "visible": seen},
                     count * (6 * real + 4) + seen * 5 * real,
                     count * EARLY_OPERATIONS + seen * OPERATIONS)
