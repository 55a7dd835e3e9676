"""What is known of the computer whose devices are used."""

import math
import os
import sys


def host_memory() -> float:
    """Bytes of memory of this computer, as far as that can be known."""
    if sys.platform == "win32":
        return math.inf
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (ValueError, OSError):
        return math.inf
