"""Lists all devices, tests which of them work, and chooses one."""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import pyopencl as cl

from clsplat.device.capabilities import probe_capabilities, probe_working
from clsplat.device.device import Device, Handle
from clsplat.device.runtimes import intel_runtime
from clsplat.errors import DeviceError

NO_DEVICE = (
    "no working OpenCL device; install one: `pip install intel-opencl-rt intel-cmplr-lib-rt` "
    "(Linux, any x86-64 CPU), `apt-get install pocl-opencl-icd`, or your GPU vendor's driver"
)


@dataclass
class ListedDevice:
    """A device that a platform lists, and the result of its test."""

    index: int  # its number, as --device takes it
    platform: str
    name: str
    type: str  # "gpu", "cpu", "accelerator", or "-" for a platform without devices
    handle: Any  # pyopencl's device; None for a platform without devices
    reason: str = ""  # why it does not work; empty if it does
    capabilities: dict[str, Any] = field(default_factory=dict)  # its sizes and optional features
    chosen: bool = False  # whether "auto" means this device

    @property
    def works(self) -> bool:
        """Whether a two-line kernel gave the right results."""
        return not self.reason

    @property
    def cure(self) -> str:
        """What to do where it does not work."""
        if self.handle is None:
            return "none needed, unless you expected one: then its driver is missing"
        if "Portable Computing" in self.platform and "target CPU" in self.reason:
            return (
                "PyPI's PoCL is too old for this CPU: `pip uninstall "
                "pocl-binary-distribution`, then `apt-get install pocl-opencl-icd` or "
                "`pip install intel-opencl-rt intel-cmplr-lib-rt`"
            )
        return "update or reinstall this device's driver"


def list_devices() -> list[ListedDevice]:
    """Test every device of every platform, and mark the one that "auto" chooses.

    A platform without devices appears as one entry that does not work, so that everything that is
    installed is explained.
    """
    entries = _enumerate()
    for entry in entries:
        handle = entry.handle
        entry.reason = probe_working(handle) if handle else "the platform lists no device"
        if entry.works:
            entry.capabilities = {
                "compute_units": handle.max_compute_units,
                "memory_bytes": handle.global_mem_size,
                "largest_buffer_bytes": handle.max_mem_alloc_size,
                "local_bytes": handle.local_mem_size,
                "opencl_c": handle.opencl_c_version.strip(),
                **probe_capabilities(cl.Context([handle]), handle),
            }
    if working := [entry for entry in _ranked(entries) if entry.works]:
        working[0].chosen = True
    return entries


def _enumerate() -> list[ListedDevice]:
    """Every device, not yet tested, in the order of the platforms."""
    entries: list[ListedDevice] = []
    platforms: list[Any] = []
    with suppress(cl.LogicError), intel_runtime():  # raised where there is no platform
        platforms = cl.get_platforms()
    for platform in platforms:
        handles: list[Any] = []
        with suppress(cl.Error):
            handles = platform.get_devices()
        for handle in handles or [None]:
            entries.append(
                ListedDevice(
                    len(entries), platform.name.strip(), handle.name.strip() if handle else "-", _type(handle), handle
                )
            )
    return entries


def _type(handle: Handle | None) -> str:
    if handle is None:
        return "-"
    for name in ("gpu", "cpu"):
        if handle.type & getattr(cl.device_type, name.upper()):
            return name
    return "accelerator"


def _ranked(entries: Iterable[ListedDevice]) -> list[ListedDevice]:
    """Best first: a GPU if there is one (most memory first), else the fastest CPU runtime."""

    def rank(entry: ListedDevice) -> tuple[bool, bool, int, int]:
        label = entry.platform + entry.name
        emulated = any(word in label for word in ("Oclgrind", "FPGA", "llvmpipe"))
        memory = entry.handle.global_mem_size if entry.type == "gpu" else 0
        # Intel's compiler vectorises best on every x86-64 CPU we measured, then PoCL
        runtime = 2 * ("Intel" in entry.platform) + ("Portable" in entry.platform)
        return not emulated, entry.type == "gpu", memory, runtime

    return sorted((e for e in entries if e.handle is not None), key=rank, reverse=True)


def choose_device(spec: str = "auto", **open_options: Any) -> Device:
    """Open the device of `choose_handle`; `open_options` are parameters of `Device`."""
    return Device(choose_handle(spec), **open_options)


def choose_handle(spec: str = "auto") -> Handle:
    """The best device that works and matches `spec`.

    Parameters
    ----------
    spec : "auto", "cpu", "gpu", an index of `list_devices`, or part of a platform's or device's
        name.

    Raises
    ------
    DeviceError : no device works; the message says which ones were tried, and why they failed.
    """
    entries = _enumerate()
    if spec.isdigit():
        matching = [entry for entry in entries if entry.index == int(spec)]
    elif spec in ("auto", "cpu", "gpu"):
        matching = [entry for entry in entries if spec in ("auto", entry.type)]
    else:
        matching = [entry for entry in entries if spec.lower() in f"{entry.platform} {entry.name}".lower()]
    skipped = []
    for entry in _ranked(matching):
        handle: Handle = entry.handle
        if not (reason := probe_working(handle)):
            return handle
        skipped.append(f"{entry.platform} {entry.name}: {reason}")
    if skipped:
        raise DeviceError(f"no working device for '{spec}' ({'; '.join(skipped)}); {NO_DEVICE}")
    if entries and spec != "auto":
        raise DeviceError(f"no device matches '{spec}'; `clsplat devices` lists all devices")
    raise DeviceError(NO_DEVICE)
