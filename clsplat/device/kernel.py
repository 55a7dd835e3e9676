"""A kernel and its contract: what it is called with, checked when it is built and launched, and
over how many work-items each of its forms runs.

Sizes of a launch are products of names, "count width" or "M W/TILE H/TILE", where A/B rounds up. A
name is a scalar argument, a letter of an array's shape, a number, one of clsplat/constants.py or
one of `DEVICE_SIZES`; the kernels know the last two by the same names.
"""

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import pyopencl as cl

from clsplat.constants import SHARED
from clsplat.errors import DeviceError, ShapeError

SCALARS = {
    "int": np.int32, "uint": np.uint32, "ulong": np.uint64, "float": np.float32, "uchar": np.uint8}
DEVICE_SIZES = {"TILE": "tile", "SCAN_GROUP": "scan_group"}  # name -> attribute of Device
RUNS_A_CORE = 4  # of the item form: enough for cores that are not equally busy


class Forms(NamedTuple):
    """What differs between the two forms of kernels.

    item : where a work-item owns a tile, a chunk or a row (CPUs)
    group : where a work-group does (GPUs)
    """

    item: Any
    group: Any

    def of(self, device):
        """That of the form in which the device is open."""
        return getattr(self, device.form)


@dataclass(frozen=True)
class Launch:
    """How one form of a kernel is launched: made by `each`, `items` or `groups`.

    units : how many elements, work-items or groups
    group : work-items a group
    arguments : those of this form alone, which follow the others
    """

    kind: str
    units: str
    group: str = ""
    arguments: dict = field(default_factory=dict)

    def __str__(self):
        units, group = (" × ".join(text.split()) for text in (self.units, self.group))
        if self.kind == "items":
            return f"{units} items" + f", groups of {group}" * (group != "1")
        return f"each of {units}" if self.kind == "each" else f"{units} groups of {group}"


def each(elements):
    """For a kernel written with FOR_EACH (cl/include/each.h): work-items for so many elements."""
    return Launch("each", elements)


def items(units, group="1", **arguments):
    """So many work-items, in groups of `group`; arguments: see `Launch`."""
    return Launch("items", units, group, arguments)


def groups(units, group, **arguments):
    """So many groups of `group` work-items; arguments: see `Launch`."""
    return Launch("groups", units, group, arguments)


class Kernel:
    """One kernel function: Kernel(file, function, each("count"), count="uint", ...).

    launch : a Launch of both forms, or `Forms` of one each
    arguments : in the order of the OpenCL signature; a string is a scalar of that type, a tuple an
        array: its type, then its shape, where equal letters must agree. `real` is float, or double
        on a device opened for double precision
    """

    declared = {}  # file -> its kernels, as far as their modules were imported

    def __init__(self, file, function, launch, **arguments):
        self.file, self.function = file, function
        self.launches = launch if isinstance(launch, Forms) else Forms(launch, launch)
        self.forms = Forms(*(Contract(file, function, each_form, arguments)
                             for each_form in self.launches))
        self.names = self.forms.item.arguments.keys() | self.forms.group.arguments.keys()
        self.declared.setdefault(file, []).append(self)

    def __repr__(self):
        return f"{self.function} in {self.file}"

    def bind(self, device, values):
        """A `Call`. values: the arguments of both forms by name; those of the other form alone are
        left out. ShapeError names what is missing, unknown, or of a wrong type or shape."""
        if values.keys() != self.names:
            wrong = values.keys() ^ self.names
            raise ShapeError(f"{self}: missing or unknown arguments {sorted(wrong)}")
        return Call(self, *self.forms.of(device).bind(device, values))

    def units(self, device, **sizes):
        """How many elements, work-items or groups a launch of these sizes has, by their names."""
        return self.forms.of(device).units(device, sizes)


class Call(NamedTuple):
    """A kernel and its arguments in their order, checked; nbytes: of its arrays; items: work-items,
    whole groups; group: work-items a group."""

    kernel: Kernel
    arguments: list
    nbytes: int
    items: int
    group: int


class Contract:
    """One form of a Kernel."""

    def __init__(self, file, function, launch, arguments):
        self.file, self.function, self.launch = file, function, launch
        self.arguments = {**arguments, **launch.arguments}
        self.signature = repr((function, *self.arguments.items()))
        # (name, dtype or None for the device's real, shape or None for a scalar)
        self._checks = [
            (name, None, None) if isinstance(a, str) else
            (name, None if a[0] == "real" else np.dtype(SCALARS[a[0]]), a[1:])
            for name, a in self.arguments.items()]
        self._fixed = {n: n for _, _, shape in self._checks for n in shape or ()
                       if isinstance(n, int)}
        known = {name for name, a in self.arguments.items() if isinstance(a, str)}.union(
            DEVICE_SIZES, *(shape for _, _, shape in self._checks if shape))
        self._units, self._group = (self._factors(text, known)
                                    for text in (launch.units, launch.group))

    def __repr__(self):
        return f"{self.function} in {self.file}"

    def _factors(self, text, known):
        """[(name or number, divisor), ...] of a size; DeviceError names what nobody knows."""
        factors = []
        for word in text.split():
            parts = [int(part) if part.isdigit() else SHARED.get(part, part)
                     for part in (*word.split("/"), "1")]
            if unknown := [part for part in parts if isinstance(part, str) and part not in known]:
                raise DeviceError(f"{self}: launched by '{unknown[0]}', which is no argument")
            factors.append(parts[:2])
        return factors

    def bind(self, device, values):
        """What makes a Call of a kernel; values: see `Kernel.bind`."""
        real, sizes, arguments, nbytes = device.real, self._fixed.copy(), [], 0
        for name, dtype, shape in self._checks:  # every launch comes by: no step to spare
            value = values[name]
            if shape is None:
                sizes[name] = value
                arguments.append(value)
                continue
            if value.dtype != (dtype or real):
                raise ShapeError(f"{self}: '{name}' is {value.dtype}, wants {dtype or real}")
            fits = len(value.shape) == len(shape)
            for wanted, length in zip(shape, value.shape):
                if sizes.setdefault(wanted, length) != length:
                    fits = False
            if not fits:
                bound = {k: v for k, v in sizes.items() if isinstance(k, str)}
                raise ShapeError(f"{self}: '{name}' has shape {value.shape}, wants {shape} "
                                 f"where {bound}")
            arguments.append(value.buffer)
            nbytes += value.nbytes
        return arguments, nbytes, *self._work(device, sizes)

    def units(self, device, sizes):
        """As of `Kernel.units`; completes `sizes` by those of the device."""
        for name, attribute in DEVICE_SIZES.items():
            sizes[name] = getattr(device, attribute)
        return _product(self._units, sizes)

    def _work(self, device, sizes):
        """(work-items in whole groups, work-items a group)."""
        units, group = self.units(device, sizes), _product(self._group, sizes)
        if self.launch.kind == "groups":
            return units * group, group
        if self.launch.kind == "each":
            if device.form == "item":
                return min(units, RUNS_A_CORE * device.compute_units), 1
            group = device.group_size
        return -(-units // group) * group, group

    def check_built(self, built):
        """Compare with the compiler's own signature, so that no two arguments can be swapped."""
        if built.num_args != len(self.arguments):
            raise DeviceError(
                f"{self}: takes {built.num_args} arguments, {len(self.arguments)} declared")
        for index, (name, argument) in enumerate(self.arguments.items()):
            actual, kind = _signature(built, index)
            if actual is None:  # a driver that withholds names
                return
            wanted = argument if isinstance(argument, str) else argument[0] + "*"
            if actual != name or not _same_type(kind, wanted):
                raise DeviceError(
                    f"{self}: argument {index} is '{kind} {actual}', declared '{wanted} {name}'")


def _product(factors, sizes):
    return math.prod(-(-sizes.get(size, size) // sizes.get(by, by)) for size, by in factors)


def _signature(built, index):
    try:
        return (built.get_arg_info(index, cl.kernel_arg_info.NAME),
                built.get_arg_info(index, cl.kernel_arg_info.TYPE_NAME))
    except cl.Error:
        return None, None


def _same_type(actual, declared):
    """Whether the compiler's type name is the declared one; `real` stands for either precision."""
    actual = actual.replace(" ", "").replace("unsignedint", "uint").replace("unsignedchar", "uchar")
    base, pointer = declared.rstrip("*"), declared.endswith("*")
    bases = ("float", "double", "real") if base == "real" else (base,)
    if pointer:  # wider loads of the same scalars are fine: float4* reads float rows
        return actual.endswith("*") and actual.rstrip("*").rstrip("0123456789") in bases
    return actual in bases
