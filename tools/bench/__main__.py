"""Wall times of kernel families, after a warm-up.

    python -m tools.bench [FAMILY] [--device auto] [--form auto] [--gaussians 200k,1M] [--json]

Without FAMILY, lists all. `render` is a whole frame and its adjoint.
"""

import argparse

from clsplat.device import choose_device
from tools.bench.families import FAMILIES, time_family
from tools.bench.render import time_frames
from tools.bench.report import Bench, counts


def main(argv=None):
    """Run one benchmark."""
    parser = argparse.ArgumentParser(prog="python -m tools.bench", description=__doc__)
    parser.add_argument("family", nargs="?", choices=[*sorted(FAMILIES), "render"])
    parser.add_argument("--device", default="auto")
    parser.add_argument("--form", default="auto", choices=("auto", "item", "group"))
    parser.add_argument("--gaussians", type=counts, default="200k")
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--json", action="store_true", help="JSON lines in place of a table")
    options = parser.parse_args(argv)
    if options.family is None:
        print("\n".join([*sorted(FAMILIES), "render"]))
        return
    device = choose_device(options.device, form=options.form)
    bench = Bench(device, options.gaussians, options.repeats, options.json)
    if options.family == "render":
        time_frames(bench)
    else:
        time_family(options.family, bench)


if __name__ == "__main__":
    main()
