"""The mean of the gradients of several views, here of the same view several times."""

from functools import partial

from clsplat.device import Array
from clsplat.gaussians import LEARNED
from clsplat.optimise.batch import BatchMean
from clsplat.primitives.compact import new_counts
from clsplat.rendering.pipeline import Gradients
from clsplat.rendering.project import Rows

from .measure import Bench
from .workloads import CityFrame

USED = {field.name: field.width(3) for field in LEARNED}


def main(argv: list[str]) -> None:
    """Run this benchmark with its flags."""
    bench = Bench(argv, __doc__, gaussians="200k", views=[1, 4])
    for count in bench.options.gaussians:
        city = CityFrame(bench.device, count)
        gradients, counts = city.gradients(), new_counts(bench.device)
        visible, width = len(gradients.rows), sum(USED.values())
        for views in bench.options.views:
            batch = BatchMean(bench.device, learned(city.rows), views)
            times = bench.milliseconds(partial(mean, batch, gradients, counts))
            # sums are cleared, read and written once a view, the gradient is read; then gathered
            reals = count * width + 3 * views * visible * width + 2 * visible * width
            bench.report("batch", f"mean of {views}", times,
                         {"gaussians": count, "visible": visible, "views": views},
                         reals * bench.device.real.itemsize, 2 * views * visible * width)


def learned(rows: Rows) -> dict[str, Array]:
    """The rows that have gradients."""
    return {name: rows[name] for name in USED}


def mean(batch: BatchMean, gradients: Gradients, counts: Array) -> Gradients:
    """The mean of so many views as the batch has, without waiting."""
    for _ in range(batch.views):
        batch.add(gradients, USED)
    return batch.mean(counts, USED, batch.count)
