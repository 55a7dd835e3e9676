"""Which gaussians a camera sees (cl/cull.cl)."""

import numpy as np

from clsplat.constants import CAMERA_REALS
from clsplat.device import Array, Device, Forms, Kernel, groups, items
from clsplat.primitives.compact import chunk_size, chunks_of
from clsplat.rendering.blend import Defines
from clsplat.rendering.project import Rows

CULL = Kernel(
    "cull.cl",
    "cull",
    Forms(item=items("count/chunk"), group=groups("count/chunk", "SCAN_GROUP")),
    count="uint",
    chunk="uint",
    camera=("real", CAMERA_REALS),
    positions=("real", "N", 3),
    log_scales=("real", "N", 3),
    quaternions=("real", "N", 4),
    opacity_logits=("real", "N"),
    flags=("uint", "N"),
    totals=("uint", "T"),
)


def cull(device: Device, rows: Rows, camera: Array, defines: Defines) -> tuple[Array, Array]:
    """Find the gaussians that a packed camera sees.

    Returns
    -------
    uint[N], 1 for those that the image shows, and uint[chunks], how many of each chunk these are,
    for `compact`.
    """
    count = len(rows["positions"])
    flags = device.empty(count, np.uint32)
    totals = device.empty(chunks_of(device, count), np.uint32)
    device.launch(
        CULL,
        defines,
        count=count,
        chunk=chunk_size(device, count),
        camera=camera,
        positions=rows["positions"],
        log_scales=rows["log_scales"],
        quaternions=rows["quaternions"],
        opacity_logits=rows["opacity_logits"],
        flags=flags,
        totals=totals,
    )
    return flags, totals
