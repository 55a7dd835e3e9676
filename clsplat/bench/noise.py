"""Random steps of the positions of a model of which one gaussian in so many is transparent."""

from functools import partial

import numpy as np

from clsplat.optimise.noise import add_noise
from clsplat.primitives.compact import new_counts

from .measure import Bench
from .workloads import CityFrame

AMOUNT = 1e-6  # so that the model stays what it is
MOVED_REALS, TESTED_REALS = 13, 1  # read and written of a row that moves, and of any other


def main(argv: list[str]) -> None:
    """Run this benchmark with its flags."""
    bench = Bench(argv, __doc__, gaussians="200k,1M", transparent=[10, 1])
    device = bench.device
    for count in bench.options.gaussians:
        city, counts = CityFrame(device, count), new_counts(device)
        for every in bench.options.transparent:
            city.rows["opacity_logits"].write(
                np.where(np.arange(count) % every == 0, -9.0, 2.0).astype(device.real))
            times = bench.milliseconds(partial(add_noise, city.rows, AMOUNT, 1, 0, counts))
            reals = TESTED_REALS * count + MOVED_REALS * (count // every)
            bench.report("noise", f"one in {every}", times, {"gaussians": count},
                         reals * device.real.itemsize, 100 * (count // every))
