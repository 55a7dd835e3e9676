"""A folder that another process holds."""

import subprocess
import sys
from contextlib import contextmanager

HOLD = (
    "import sys\nfrom clsplat.io.lock import exclusive\n"
    "with exclusive(sys.argv[1]):\n    print('held', flush=True)\n    sys.stdin.read()"
)


@contextmanager
def held_elsewhere(folder):
    """Yields the number of the process that holds the folder until the block ends."""
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout.readline() == "held\n"
        yield other.pid
        other.stdin.close()
