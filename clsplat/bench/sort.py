"""The stable sort of a frame's visible gaussians by depth, which the item form of binning needs."""

from functools import partial

from clsplat.constants import COUNT_VISIBLE
from clsplat.primitives.sort import DIGIT_BITS, KEY_BITS, stable_sort
from clsplat.rendering.project import project

from .cull import DEFINES
from .measure import Bench
from .workloads import CityFrame


def main(argv: list[str]) -> None:
    """Run this benchmark with its flags."""
    bench = Bench(argv, __doc__, gaussians="200k")
    device = bench.device
    for count in bench.options.gaussians:
        city = CityFrame(device, count)
        counts = city.frame.counts
        _, depths = project(device, city.rows, city.frame.visible, counts, city.camera, 0, DEFINES)
        times = bench.milliseconds(partial(stable_sort, device, depths, counts))
        bench.report("sort", "depths", times, {"gaussians": count, "keys": len(depths)},
                     *sort_work(int(counts.download()[COUNT_VISIBLE])))


def sort_work(count: int) -> tuple[int, int]:
    """The bytes and the operations of sorting `count` keys."""
    passes = -(-KEY_BITS // DIGIT_BITS)
    # a pass reads keys twice and values, but for the first, and writes both; its digit is a shift
    # and a mask, twice, and counts up twice
    return count * (20 * passes - 4), 6 * count * passes
