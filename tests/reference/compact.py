"""The rows that a flag keeps."""

import numpy as np


def compact(flags, room):
    """(kept, failed): the numbers int64[K] of the rows whose flag is set, ascending; none of them,
    and True, where they are more than `room`."""
    kept = np.flatnonzero(flags)
    failed = len(kept) > room
    return kept[:0] if failed else kept, failed
