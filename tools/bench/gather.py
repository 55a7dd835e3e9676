"""Rows by index and back, at the order that a frame saw its gaussians; and compaction."""

from functools import partial

from clsplat.primitives.gather import compact, gather, scatter
from clsplat.render.project import cull

from .measure import arguments, milliseconds, open_device, report
from .project import DEFINES
from .workloads import CityFrame


def main(argv):
    options = arguments(argv, __doc__, gaussians=200_000)
    device = open_device(options)
    city = CityFrame(device, options.gaussians)
    visible = city.frame.visible
    for name in ("positions", "sh_rest"):
        rows = city.rows[name]
        taken = gather(device, rows, visible)
        counts = dict(rows=len(visible), bytes=2 * taken.nbytes + visible.nbytes)
        cases = {"gather": partial(gather, device, rows, visible, taken),
                 "scatter": partial(scatter, device, taken, visible, rows)}
        for case, function in cases.items():
            times = milliseconds(device, function, options.repeats)
            report(options, device, "gather", f"{case} {name}", times, **counts)
    flags, keys = cull(device, city.rows, city.camera, DEFINES)
    times = milliseconds(device, lambda: compact(device, flags, keys), options.repeats)
    report(options, device, "gather", "compact, with its scan", times, rows=len(flags),
           kept=len(visible))
