"""Column sums: of the partial sums of an image loss, and of one value for each gaussian."""

from functools import partial

import numpy as np

from clsplat.primitives.reduce import sum_columns

from .measure import Bench


def main(argv: list[str]) -> None:
    """Run this benchmark with its flags."""
    bench = Bench(argv, __doc__, gaussians="200k")
    rng = np.random.default_rng(0)
    # 3 channels of 1019 x 766 pixels in tiles of 16 x 16
    cases = [("loss", (3 * 64 * 48, 2)),
             *(("gaussians", (count, 1)) for count in bench.options.gaussians)]
    for case, shape in cases:
        rows = bench.device.upload(rng.random(shape))
        times = bench.milliseconds(partial(sum_columns, bench.device, rows))
        bench.report("reduce", case, times, {"rows": shape[0], "columns": shape[1]}, rows.nbytes,
                     shape[0] * shape[1])
