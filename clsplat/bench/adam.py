"""Adam: a step's two launches, and how rows that lag catch up, for several shares of visible rows,
with moments as floats and as halves; and the numpy engine."""

from functools import partial

import numpy as np

from clsplat.constants import CATCH_UP_EVERY, LAG_TERMS
from clsplat.device import Array, Device
from clsplat.gaussians import LEARNED
from clsplat.optimise.adam import DeviceAdam
from clsplat.optimise.numpy_adam import NumpyAdam
from clsplat.primitives.compact import new_counts
from clsplat.rendering.pipeline import Gradients
from clsplat.rendering.project import FieldGradients, Rows

from .measure import Bench
from .workloads import CityFrame

USED = {field.name: field.width(3) for field in LEARNED}
RATES = {field.name: field.rate for field in LEARNED}
WIDTH = sum(USED.values())
OPERATIONS = 14  # a parameter
LAG = 20  # steps that a row has missed


def main(argv: list[str]) -> None:
    """Run this benchmark with its flags."""
    bench = Bench(argv, __doc__, gaussians="200k", share=[0.05, 0.25, 1.0], no_numpy=False)
    real = bench.device.real.itemsize
    for count in bench.options.gaussians:
        city = CityFrame(bench.device, count)
        for share in bench.options.share:
            gradients = gradients_of(bench.device, count, share)
            seen = len(gradients.rows)
            is_other = np.ones(count, np.uint32)
            is_other[gradients.rows.download()] = 0
            others = bench.device.upload(is_other)
            size = {"gaussians": count, "visible": seen}
            # parameters and moments are read and written; 20 floats of gradients and what is masked
            reals, operations = seen * (6 * WIDTH + 20), OPERATIONS * seen * WIDTH
            for moments in ("float", "half"):
                less = (moments == "half") * seen * 4 * USED["sh_rest"] * (real - 2)
                adam = DeviceAdam(bench.device, city.rows, False, moments)
                times = bench.milliseconds(
                    partial(adam.step, city.rows, gradients, 1, RATES, USED), warm_up=1)
                bench.report("adam", f"step, {moments}", times, size, reals * real - less,
                             operations)
                times = bench.milliseconds(
                    partial(catch_up, lazy(bench, city, moments), city.rows, others), warm_up=1)
                bench.report("adam", f"catch up, {moments}", times, size,
                             6 * WIDTH * seen * real - less + 12 * count, operations)
            if not bench.options.no_numpy:
                for dense in (False, True):
                    host = NumpyAdam(bench.device, city.rows, dense)
                    times = bench.milliseconds(
                        partial(host.step, city.rows, gradients, 1, RATES, USED), warm_up=1)
                    bench.report("adam", f"numpy {'dense' if dense else 'sparse'}", times, size)
        seen = len(city.frame.visible)
        times = bench.milliseconds(partial(catch_up, lazy(bench, city, "float"), city.rows, None,
                                           city.camera), warm_up=1)
        bench.report("adam", "catch up by camera", times, {"gaussians": count, "visible": seen},
                     (6 * WIDTH * seen + 7 * count) * real, OPERATIONS * seen * WIDTH)


def gradients_of(device: Device, count: int, share: float) -> Gradients:
    """Random gradients of the first view's kind for a share of the rows, in runs as a view sees."""
    rng = np.random.default_rng(0)
    seen = max(1, int(share * count))
    chosen = np.sort(rng.permutation(-(-count // 16))[:-(-seen // 16)])
    indices = (chosen[:, None] * 16 + np.arange(16)).ravel()
    rows = device.upload(indices[indices < count].astype(np.uint32))

    def random(*shape: int) -> Array:
        return device.upload(rng.normal(0, 1e-4, (len(rows), *shape)))

    stored = {field.name: random(*field.row_shape(3)) for field in LEARNED
              if not field.name.startswith("sh_")}
    counts = new_counts(device, len(rows))
    fields = FieldGradients(device, stored, random(3), random(3), 15,
                            (("SH_REST", 15), ("ANTIALIASED", 0), ("DEGREE", 3)), counts)
    return Gradients(fields, None, rows, rows, counts)


def lazy(bench: Bench, city: CityFrame, moments: str) -> DeviceAdam:
    """An engine whose sums by which rows catch up are not zero."""
    adam = DeviceAdam(bench.device, city.rows, True, moments)
    adam.load_lag({**adam.lag(), "coefficients": np.full((CATCH_UP_EVERY, LAG_TERMS), 1e-9)}, 0)
    return adam


def catch_up(adam: DeviceAdam, rows: Rows, frozen: Array | None, camera: Array | None = None
             ) -> None:
    """Let all rows that are not frozen miss LAG steps, and catch up."""
    adam.steps, adam.is_current = adam.steps + LAG, False
    if camera is None:
        adam.catch_up(rows, frozen)
    else:
        numbers = adam.numbers(adam.steps + 1, RATES)
        adam.catch_up_seen(rows, numbers, 3, frozen, camera, new_counts(adam.device))
