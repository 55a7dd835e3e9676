"""`clsplat.Device`: an OpenCL device, chosen by its name, kind or number."""

import functools

from clsplat.device import Device as OpenedDevice
from clsplat.device import choose_handle
from clsplat.errors import InputError
from clsplat.report.notebook import table


class Device(OpenedDevice):
    """An open OpenCL device.

    Parameters
    ----------
    name : "auto" (a GPU if there is one, otherwise the fastest CPU runtime), "cpu", "gpu", the
        device's number in `clsplat devices`, or a part of its name.
    form : of the kernels: "item" (for CPUs), "group" (for GPUs) or "auto" (by the device).
    precision : of real numbers on the device, "float" or "double".

    Raises
    ------
    clsplat.ClsplatError : if no such device works; the message says why, and the cure.
    """

    def __init__(self, name: str | int = "auto", *, form: str = "auto", precision: str = "float") -> None:
        for value, choices in ((form, ("auto", "item", "group")), (precision, ("float", "double"))):
            if value not in choices:
                raise InputError(f"{value!r}: not one of {', '.join(choices)}")
        super().__init__(choose_handle(str(name)), precision=precision, form=form)

    def __repr__(self) -> str:
        return f"<clsplat.Device {self.name!r}, {self.form} form>"

    def _repr_html_(self) -> str:
        memory = self.handle.global_mem_size / 2**30
        rows = {
            "device": self.name,
            "platform": self.handle.platform.name.strip(),
            "memory": f"{memory:.1f} GiB",
            "kernels": f"{self.form} form",
        }
        return table(rows)


def opened_device(device: OpenedDevice | None) -> OpenedDevice:
    """The device, or the default one for None; InputError for anything but an open device."""
    if device is None:
        return best_device()
    if not isinstance(device, OpenedDevice):
        raise InputError(f"device {device!r}: not an open device; give clsplat.Device({device!r})")
    return device


@functools.cache
def best_device() -> Device:
    """The default device, opened once."""
    return Device()
