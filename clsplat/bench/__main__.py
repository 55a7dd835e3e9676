"""`python -m clsplat.bench FAMILY [--json] [--device SPEC] ...`"""

import importlib
import sys

from . import families


def main(argv: list[str]) -> int:
    """Run a benchmark and return the exit code; without arguments, list the families."""
    if not argv or argv[0] not in families():
        print(f"families: {', '.join(families())}")
        return 0 if not argv else 2
    importlib.import_module(f"{__package__}.{argv[0]}").main(argv[1:])
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
