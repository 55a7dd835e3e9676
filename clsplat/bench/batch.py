"""The mean of the gradients of several views, here of the same view several times."""

from functools import partial

from clsplat.gaussians import LEARNED
from clsplat.optimise.batch import batch_mean

from .measure import Bench
from .workloads import CityFrame

USED = {field.name: field.width(3) for field in LEARNED}


def main(argv: list[str]) -> None:
    """Run this benchmark with its flags."""
    bench = Bench(argv, __doc__, gaussians="200k", views=[1, 4])
    for count in bench.options.gaussians:
        gradients = CityFrame(bench.device, count).gradients()
        visible, width = len(gradients.rows), sum(USED.values())
        for views in bench.options.views:
            times = bench.milliseconds(
                partial(batch_mean, bench.device, count, views, views * [gradients], USED))
            # sums are cleared, read and written once a view, the gradient is read; then gathered
            reals = count * width + 3 * views * visible * width + 2 * visible * width
            bench.report("batch", f"mean of {views}", times,
                         {"gaussians": count, "visible": visible, "views": views},
                         reals * bench.device.real.itemsize, 2 * views * visible * width)
