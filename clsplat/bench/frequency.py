"""The nine scene frequencies of the city, including their download."""

from functools import partial

from clsplat.training.frequency import scene_frequency

from .measure import Bench
from .workloads import city


def main(argv: list[str]) -> None:
    """Run this benchmark with its flags."""
    bench = Bench(argv, __doc__, gaussians="200k")
    for count in bench.options.gaussians:
        gaussians, _ = city(count)
        rows = {name: bench.device.upload(gaussians.rows[name])
                for name in ("log_scales", "opacity_logits")}
        times = bench.milliseconds(partial(scene_frequency, bench.device, rows))
        # the maxima and then the sums each read every row and make its terms (ten functions of 20
        # operations); then come 11 maxima, or 11 exponentials and sums
        bench.report("frequency", "nine values", times, {"gaussians": count},
                     2 * sum(array.nbytes for array in rows.values()),
                     count * (2 * 230 + 11 + 22 * 11))
