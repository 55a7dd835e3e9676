"""The rows whose flag is set, in order (cl/compact.cl)."""

import numpy as np

from clsplat.constants import COUNT_VISIBLE, FRAME_COUNTS, PER_ITEM
from clsplat.device import Array, Device, Forms, Kernel, groups, items
from clsplat.device.kernel import Argument

SMALLEST_CHUNK = 4096  # rows, of the item form: a second thread costs more than it saves

_CHUNKS = Forms(item=items("count/chunk"), group=groups("count/chunk", "SCAN_GROUP"))
_ROWS: dict[str, Argument] = dict(count="uint", chunk="uint", flags=("uint", "N"), totals=("uint", "T"))
COUNT_FLAGS = Kernel("compact.cl", "count_flags", _CHUNKS, **_ROWS)
COMPACT = Kernel(
    "compact.cl",
    "compact",
    _CHUNKS,
    count="uint",
    chunk="uint",
    room="uint",
    flags=("uint", "N"),
    totals=("uint", "T"),
    kept=("uint", "R"),
    counts=("uint", FRAME_COUNTS),
)


def chunk_size(device: Device, count: int) -> int:
    """Rows in a chunk: enough chunks for every core, or a fixed number for a group."""
    return int(
        Forms(item=max(SMALLEST_CHUNK, -(-count // (2 * device.compute_units))), group=device.scan_group * PER_ITEM).of(
            device
        )
    )


def chunks_of(device: Device, count: int) -> int:
    """The number of chunks of `count` rows."""
    return -(-count // chunk_size(device, count))


def compact(device: Device, flags: Array, counts: Array, room: int | None = None, totals: Array | None = None) -> Array:
    """The numbers of the rows whose flag is 1, ascending.

    Parameters
    ----------
    flags : uint[N], 0 or 1.
    counts : uint[FRAME_COUNTS], whose COUNT_VISIBLE becomes the number of these rows.
    room : the largest number that is expected; a frame with more fails (cl/include/counts.h).
        None: any number is possible; waits for the device.
    totals : uint[chunks], the sums of the flags of each chunk; None: they are computed.

    Returns
    -------
    uint[room], of which the first counts[COUNT_VISIBLE] are written; without a room exactly these.
    """
    count = len(flags)
    kept = device.empty(count if room is None else room, np.uint32)
    rows = dict(count=count, chunk=chunk_size(device, count), flags=flags)
    if totals is None:
        totals = device.empty(chunks_of(device, count), np.uint32)
        device.launch(COUNT_FLAGS, **rows, totals=totals)
    device.launch(COMPACT, **rows, totals=totals, room=len(kept), kept=kept, counts=counts)
    return kept if room is not None else kept.narrow(int(counts.download()[COUNT_VISIBLE]))


def new_counts(device: Device, visible: int = 0) -> Array:
    """The counts of frames, uint[FRAME_COUNTS], zero but for the gaussians that are visible."""
    counts = device.empty(FRAME_COUNTS, np.uint32)
    counts.fill(0)
    if visible:
        values = np.zeros(FRAME_COUNTS, np.uint32)
        values[COUNT_VISIBLE] = visible
        counts.write(values)
    return counts
