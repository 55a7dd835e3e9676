"""The list of a frame's visible gaussians from their flags."""

from functools import partial

from clsplat.primitives.compact import compact, new_counts
from clsplat.rendering.cull import cull

from .cull import DEFINES
from .measure import Bench
from .workloads import CityFrame


def main(argv: list[str]) -> None:
    """Run this benchmark with its flags."""
    bench = Bench(argv, __doc__, gaussians="200k")
    device = bench.device
    for count in bench.options.gaussians:
        city = CityFrame(device, count)
        seen, counts = len(city.frame.visible), new_counts(device)
        flags, totals = cull(device, city.rows, city.camera, DEFINES)
        cases = {  # function, how often flags are read
            "totals from culling": (
                partial(compact, device, flags, counts, seen, totals), 1),
            "with its totals": (partial(compact, device, flags, counts, seen), 2)}
        for case, (function, reads) in cases.items():
            # a flag is added up as often as it is read, and a row number is kept
            bench.report("compact", case, bench.milliseconds(function),
                         {"gaussians": count, "visible": seen},
                         reads * flags.nbytes + 4 * seen, reads * count)
