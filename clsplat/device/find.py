"""Finds every device, says which work and why others do not, and chooses one."""

from dataclasses import dataclass, field

import pyopencl as cl

from clsplat.device.capabilities import probe_capabilities, probe_working
from clsplat.device.device import Device
from clsplat.errors import DeviceError

NO_DEVICE = (
    "no working OpenCL device; install one: `pip install intel-opencl-rt intel-cmplr-lib-rt` "
    "(Linux, any x86-64 CPU), `apt-get install pocl-opencl-icd`, or your GPU vendor's driver")


@dataclass
class Found:
    """A device as listed by its platform, and what probing it gave."""

    index: int
    platform: str
    name: str
    type: str
    handle: object
    works: bool = False
    reason: str = ""
    cure: str = ""
    capabilities: dict = field(default_factory=dict)
    chosen: bool = False


def list_devices():
    """Every device of every platform as `Found`, probed, the automatic choice marked.

    A platform without devices appears as one entry that does not work, so that nothing that is
    installed goes unexplained.
    """
    found = [_probed(entry) for entry in _enumerate()]
    best = next((entry for entry in _ranked(found) if entry.works), None)
    if best is not None:
        best.chosen = True
    return found


def _enumerate():
    """Every device as an unprobed Found, in the order of the platforms."""
    found = []
    try:
        platforms = cl.get_platforms()
    except cl.LogicError:  # the loader's way of saying that there is none
        return found
    for platform in platforms:
        try:
            handles = platform.get_devices()
        except cl.Error:
            handles = []
        for handle in handles or [None]:
            found.append(Found(
                len(found), platform.name.strip(), handle.name.strip() if handle else "-",
                _type(handle), handle))
    return found


def _probed(entry):
    """The entry with its verdict and capabilities filled in."""
    handle = entry.handle
    if handle is None:
        entry.reason = "the platform lists no device"
        entry.cure = "none needed, unless you expected one: then its driver is missing"
        return entry
    entry.reason = probe_working(handle)
    entry.works = not entry.reason
    entry.cure = _cure(entry)
    if entry.works:
        entry.capabilities = {
            "compute_units": handle.max_compute_units,
            "memory_bytes": handle.global_mem_size,
            "largest_buffer_bytes": handle.max_mem_alloc_size,
            "local_bytes": handle.local_mem_size,
            "opencl_c": handle.opencl_c_version.strip(),
            **probe_capabilities(cl.Context([handle]), handle)}
    return entry


def _type(handle):
    if handle is None:
        return "-"
    for name in ("gpu", "cpu"):
        if handle.type & getattr(cl.device_type, name.upper()):
            return name
    return "accelerator"


def _cure(entry):
    if entry.works:
        return ""
    if "Portable Computing" in entry.platform and "target CPU" in entry.reason:
        return ("PyPI's PoCL is too old for this CPU: `pip uninstall pocl-binary-distribution`, "
                "then `apt-get install pocl-opencl-icd` or "
                "`pip install intel-opencl-rt intel-cmplr-lib-rt`")
    return "update or reinstall this device's driver"


def _ranked(entries):
    """Best first: a GPU if there is one (most memory first), else the fastest CPU runtime."""
    def rank(entry):
        label = entry.platform + entry.name
        emulated = any(word in label for word in ("Oclgrind", "FPGA", "llvmpipe"))
        memory = entry.handle.global_mem_size if entry.type == "gpu" else 0
        # Intel's compiler vectorises best on every x86-64 CPU we measured, then PoCL
        runtime = 2 * ("Intel" in entry.platform) + ("Portable" in entry.platform)
        return not emulated, entry.type == "gpu", memory, runtime
    return sorted((e for e in entries if e.handle is not None), key=rank, reverse=True)


def choose_device(spec="auto", **open_options):
    """Open the device of `choose_handle`; `open_options` go to `Device`."""
    return Device(choose_handle(spec), **open_options)


def choose_handle(spec="auto"):
    """pyopencl's device: "auto", "cpu", "gpu", an index of `list_devices`, or part of a name.

    Devices are probed best first until one works. Raises DeviceError that says what was skipped and
    why where none does.
    """
    entries = _enumerate()
    if spec.isdigit():
        wanted = [entry for entry in entries if entry.index == int(spec)]
    elif spec in ("auto", "cpu", "gpu"):
        wanted = [entry for entry in entries if spec in ("auto", entry.type)]
    else:
        wanted = [entry for entry in entries
                  if spec.lower() in f"{entry.platform} {entry.name}".lower()]
    skipped = []
    for entry in _ranked(wanted):
        reason = probe_working(entry.handle)
        if not reason:
            return entry.handle
        skipped.append(f"{entry.platform} {entry.name}: {reason}")
    if skipped:
        raise DeviceError(f"no working device for '{spec}' ({'; '.join(skipped)}); {NO_DEVICE}")
    if entries and spec != "auto":
        raise DeviceError(f"no device matches '{spec}'; `clsplat devices` lists what is there")
    raise DeviceError(NO_DEVICE)


def open_device(index, **open_options):
    """Open the device with that index in `list_devices`."""
    return choose_device(str(index), **open_options)
