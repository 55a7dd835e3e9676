"""Benchmarks: a module for each kernel family, and `step` and `render` for all of them together.

Each prints a table, or with --json JSON lines: family, variant, form, device, driver, size, median
and quartiles in milliseconds, bytes, operations, and both as shares of the measured peak rates of
the device. Times are wall times of work that has finished on the device, after a warm-up. Run them
with `clsplat bench FAMILY`, or from a checkout with `python -m clsplat.bench FAMILY`. `precision`
compares approximations: their error beside their time.
"""

from pathlib import Path


def families() -> list[str]:
    """Names of the modules that can be run, which are those with a `main`."""
    return sorted(path.stem for path in Path(__file__).parent.glob("*.py")
                  if not path.stem.startswith("_") and "\ndef main(" in path.read_text("utf-8"))
