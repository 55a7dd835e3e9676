"""Benchmarks: the kernel families of `families.py`, and `step` and `render` for all together.

Each prints a table, or with --json JSON lines: family, variant, form, device, driver, size, median
and quartiles in milliseconds, bytes, operations, and both as shares of the measured peak rates of
the device. Times are wall times of work that has finished on the device, after a warm-up. Run them
with `clsplat bench FAMILY`.
"""

from collections.abc import Sequence

from . import render, step
from .families import CITY_FAMILIES, IMAGE_FAMILIES, time_family


def families() -> list[str]:
    """Names of the benchmarks."""
    return sorted({*CITY_FAMILIES, *IMAGE_FAMILIES, "render", "step"})


def run(family: str, argv: Sequence[str]) -> None:
    """Run a benchmark.

    Parameters
    ----------
    family : one of `families`.
    argv : its flags, as of the command line; InputError for a wrong one.
    """
    if family == "step":
        step.main(argv)
    elif family == "render":
        render.main(argv)
    else:
        time_family(family, argv)
