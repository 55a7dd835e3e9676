"""Benchmarks: one module a kernel family, and `step` and `render` for the whole.

Each prints a table, or with --json JSON lines: family, case, form, device, driver, median and
quartiles in milliseconds, and what the case counts. Times are wall times of work that has finished
on the device, after warm-up. Run them with `clsplat bench FAMILY`, or from a checkout with
`python -m tools.bench FAMILY`.
"""

from pathlib import Path


def families():
    """Names of the modules that can be run: those with a `main`."""
    return sorted(path.stem for path in Path(__file__).parent.glob("*.py")
                  if not path.stem.startswith("_") and "\ndef main(" in path.read_text())
