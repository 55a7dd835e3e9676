"""Benchmarks: the kernel families of `families.py`, and `step` and `render` for all together.

Times are wall times of work that has finished on the device, after a warm-up. Run them with
`clsplat bench FAMILY`.
"""

from typing import Any

from clsplat.bench import render, step
from clsplat.bench.families import FAMILIES, time_family
from clsplat.bench.measure import Bench


def families() -> list[str]:
    """Names of the benchmarks."""
    return sorted({*FAMILIES, "render", "step"})


def run(family: str, bench: Bench, **of_step: Any) -> None:
    """Run a benchmark, one of `families`; `of_step` are further parameters of `step.main`."""
    if family == "step":
        step.main(bench, **of_step)
    elif family == "render":
        render.main(bench)
    else:
        time_family(family, bench)
