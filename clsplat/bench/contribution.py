"""The contribution of each splat of a frame."""

from functools import partial

import numpy as np

from clsplat.densify.contribution import contribution

from .measure import Bench
from .workloads import CityFrame

OPERATIONS = 45  # a pixel and splat blended


def main(argv: list[str]) -> None:
    """Run this benchmark with its flags."""
    bench = Bench(argv, __doc__, gaussians="200k")
    device, real = bench.device, bench.device.real.itemsize
    for count in bench.options.gaussians:
        city = CityFrame(device, count)
        width, height = city.frame.size
        weights = device.upload(np.random.default_rng(0).random((height, width)))
        times = bench.milliseconds(partial(contribution, device, city.frame, weights))
        # two indices, the splat and four sums a pair, and the sums again to add them up
        traffic = (city.pairs.count * (8 + 20 * real) + width * height * (4 + real)
                   + len(city.frame.splats) * 4 * real)
        blended_pixels = city.blended_pixels()
        bench.report("contribution", "all splats", times,
                     {**city.size, "blended_pixels": blended_pixels}, traffic,
                     OPERATIONS * blended_pixels)
