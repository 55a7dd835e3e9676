"""OpenCL devices: finding, probing, opening, and launching checked kernels on them.

The only package that imports pyopencl. Start with `choose_device("auto")`; allocate with
`device.empty`, `device.upload`; describe a kernel once with `Kernel(...)`, its arguments and over
how many work-items each form runs, and run it with `device.launch(KERNEL, name=value, ...)`. One
in-order queue; the host waits only on `download`.
"""

import clsplat.device.runtimes  # noqa: F401  (before anything imports pyopencl)
from clsplat.device.array import Array, ArraySpec
from clsplat.device.device import Device
from clsplat.device.find import choose_device, choose_handle, list_devices, open_device
from clsplat.device.kernel import Forms, Kernel, each, groups, items

__all__ = ["Array", "ArraySpec", "Device", "Forms", "Kernel", "choose_device", "choose_handle",
           "each", "groups", "items", "list_devices", "open_device"]
