"""OpenCL devices: lists and opens them, and launches checked kernels.

The only package that imports pyopencl. Start with `choose_device("auto")`; make temporary arrays
with `device.empty` and persistent ones with `device.allocate` or `device.upload`; declare a kernel
once with `Kernel(...)`, its arguments and the number of work-items of each form, and run it with
`device.launch(KERNEL, name=value, ...)`. There is one in-order queue; the host waits only when it
downloads.
"""

import clsplat.device.runtimes  # noqa: F401  (before anything imports pyopencl)
from clsplat.device.array import Array, ArraySpec, Reading, Transfers, Writing, pinned
from clsplat.device.device import Device, Handle
from clsplat.device.find import choose_device, choose_handle, list_devices
from clsplat.device.graph import Graph
from clsplat.device.kernel import Either, Forms, Kernel, Only, each, groups, items

__all__ = [
    "Array",
    "ArraySpec",
    "Device",
    "Either",
    "Forms",
    "Graph",
    "Handle",
    "Kernel",
    "Only",
    "Reading",
    "Transfers",
    "Writing",
    "choose_device",
    "choose_handle",
    "each",
    "groups",
    "items",
    "list_devices",
    "pinned",
]
