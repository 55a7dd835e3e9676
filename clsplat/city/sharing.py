"""How many blocks share a GPU."""

import os
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from clsplat.device import Device

# where several blocks train on one GPU at a time: at most so many, with so many cores of the host
# for each, in this share of its memory, of which a process takes so many bytes besides its block
MOST_SHARING, CORES_SHARING, SHARED_MEMORY, PROCESS_BYTES = 4, 4, 0.5, 700 << 20


def most_sharing(blocks: int) -> int:
    """How many of some blocks may share a GPU, by the cores of this machine."""
    return max(1, min(MOST_SHARING, blocks, (os.cpu_count() or 1) // CORES_SHARING))


def blocks_sharing(device: "Device", blocks: int, memory: float) -> int:
    """How many blocks one device trains at a time, so that a GPU works for one of them while others
    read, write and exchange; 1 on a CPU, and where blocks are as large as the device allows.

    Parameters
    ----------
    blocks : their number.
    memory : bytes that one of them takes on the device.
    """
    if device.is_cpu:
        return 1
    room = SHARED_MEMORY * device.handle.global_mem_size / (memory + PROCESS_BYTES)
    return max(1, min(most_sharing(blocks), int(room)))
