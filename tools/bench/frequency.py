"""The nine scene frequencies of the city, to the host."""

from functools import partial

from clsplat.frequency import scene_frequency

from .measure import arguments, milliseconds, open_device, report
from .workloads import city


def main(argv):
    options = arguments(argv, __doc__, gaussians=200_000)
    device = open_device(options)
    gaussians, _ = city(options.gaussians, (1024, 768))
    rows = {name: device.upload(gaussians.rows[name])
            for name in ("log_scales", "opacity_logits")}
    times = milliseconds(device, partial(scene_frequency, device, rows), options.repeats)
    # the maxima and then the sums each read every row
    report(options, device, "frequency", "city", times, rows=gaussians.count,
           bytes=2 * sum(array.nbytes for array in rows.values()))
