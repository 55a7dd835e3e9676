"""Gather and scatter of the rows of a frame's visible gaussians, in its order."""

from collections.abc import Callable
from functools import partial

from clsplat.primitives.gather import gather, scatter

from .measure import Bench
from .workloads import CityFrame


def main(argv: list[str]) -> None:
    """Run this benchmark with its flags."""
    bench = Bench(argv, __doc__, gaussians="200k")
    device = bench.device
    for count in bench.options.gaussians:
        city = CityFrame(device, count)
        visible = city.frame.visible
        size = {"gaussians": count, "visible": len(visible)}
        for name in ("positions", "sh_rest"):
            rows = city.rows[name]
            gathered = gather(device, rows, visible)
            cases: dict[str, Callable[[], object]] = {
                "gather": partial(gather, device, rows, visible, gathered),
                "scatter": partial(scatter, device, gathered, visible, rows)}
            for case, function in cases.items():
                bench.report("gather", f"{case} {name}", bench.milliseconds(function), size,
                             2 * gathered.nbytes + visible.nbytes, operations=0)
