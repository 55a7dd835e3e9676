"""A kernel and its contract: its arguments, checked when it is built and launched, and the number
of work-items over which each of its forms runs.

Sizes of a launch are products of names, "count width" or "M W/TILE H/TILE", where A/B rounds up. A
name is a scalar argument, a letter of an array's shape, a number, one of clsplat/constants.py or
one of `DEVICE_SIZES`; the kernels use the same names for the last two.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
import pyopencl as cl

from clsplat.constants import SHARED
from clsplat.errors import DeviceError, ShapeError

if TYPE_CHECKING:
    from clsplat.device.device import Device

Argument = str | tuple[Any, ...]  # see `Kernel`
Defines = tuple[tuple[str, Any], ...]  # (name, value) of the constants of a build
Factors = list[tuple[Any, Any]]  # of a size: quotients of two names or numbers
SCALARS = {
    "int": np.int32,
    "uint": np.uint32,
    "ulong": np.uint64,
    "float": np.float32,
    "ushort": np.uint16,
    "uchar": np.uint8,
}
DEVICE_SIZES = {  # name -> attribute of Device
    "TILE": "tile",
    "SCAN_GROUP": "scan_group",
    "WAVE": "wave",
    "BUCKET": "bucket",
    "ADJOINT_GROUP": "adjoint_group",
}


class Only(NamedTuple):
    """An argument that a kernel has only in builds in which a constant is not 0."""

    define: str  # the name of the constant
    argument: str | tuple[Any, ...]  # as for `Kernel`


class Either(NamedTuple):
    """An argument that has another type in builds in which a constant is not 0."""

    define: str  # the name of the constant
    argument: str | tuple[Any, ...]  # as for `Kernel`, where it is not 0
    otherwise: str | tuple[Any, ...]  # where it is

    def of(self, choices: Collection[str]) -> Argument:
        """The argument of builds in which these constants are not 0."""
        return self.argument if self.define in choices else self.otherwise


class Forms(NamedTuple):
    """A value for each of the two forms of kernels."""

    item: Any  # of the form in which a work-item owns a tile, a chunk or a row (CPUs)
    group: Any  # of the form in which a work-group does (GPUs)

    def of(self, device: Device) -> Any:
        """The value for the form in which the device is open."""
        return getattr(self, device.form)


@dataclass(frozen=True)
class Launch:
    """How one form of a kernel is launched, created by `each`, `items` or `groups`."""

    kind: str  # "each", "items" or "groups"
    units: str  # the number of elements, work-items or groups
    group: str = ""  # work-items a group
    # further arguments that only this form has
    arguments: dict[str, Argument | Only | Either] = field(default_factory=dict)


def each(elements: str) -> Launch:
    """Launch a kernel written with FOR_EACH (cl/include/each.h) for this number of elements."""
    return Launch("each", elements)


def items(units: str, group: str = "1", /, **arguments: Argument | Only | Either) -> Launch:
    """Launch `units` work-items in groups of `group`; for the arguments see `Launch`."""
    return Launch("items", units, group, arguments)


def groups(units: str, group: str, /, **arguments: Argument | Only | Either) -> Launch:
    """Launch `units` groups of `group` work-items; for the arguments see `Launch`."""
    return Launch("groups", units, group, arguments)


class Kernel:
    """One kernel function: Kernel(file, function, each("count"), count="uint", ...).

    Parameters
    ----------
    launch : of both forms, or `Forms` with one for each; None: that form has no such kernel.
    arguments : in the order of the OpenCL signature; a string is a scalar of that type, a tuple an
        array: its type, then its shape, where equal letters must agree; `Only` for one that some
        builds lack, `Either` for one that has two types. `real` is float, or double on a device
        opened for double precision.
    """

    # the kernels of each file whose modules were imported
    declared: ClassVar[dict[str, list[Kernel]]] = {}

    def __init__(self, file: str, function: str, launch: Launch | Forms, **arguments: Argument | Only | Either) -> None:
        self.file, self.function = file, function
        self.launches = launch if isinstance(launch, Forms) else Forms(launch, launch)
        own = [argument for form in self.launches if form for argument in form.arguments.items()]
        # name of an argument that some builds lack -> the constant that it depends on
        self.only = {
            name: argument.define for name, argument in (*arguments.items(), *own) if isinstance(argument, Only)
        }
        self.choices = {
            argument.define for _, argument in (*arguments.items(), *own) if isinstance(argument, (Only, Either))
        }
        self.arguments = arguments
        self._contracts: dict[tuple[str, frozenset[str]], Contract | None] = {}
        # those of a build that has all arguments
        self.forms = Forms(*(self._contract(form, frozenset(self.only.values())) for form in Forms._fields))
        self.names = {name for form in self.forms if form for name in form.arguments}
        self.declared.setdefault(file, []).append(self)

    def __repr__(self) -> str:
        return f"{self.function} in {self.file}"

    def contract(self, device: Device, defines: Defines) -> Contract:
        """What the device's form has in a build with these constants."""
        contract = self._contract(
            device.form, frozenset(name for name, value in defines if value and name in self.choices)
        )
        assert contract is not None, f"{self} has no {device.form} form"
        return contract

    def _contract(self, form: str, choices: frozenset[str]) -> Contract | None:
        if (form, choices) not in self._contracts:
            launch = getattr(self.launches, form)
            self._contracts[form, choices] = launch and Contract(self, launch, choices)
        return self._contracts[form, choices]

    def bind(self, device: Device, values: Mapping[str, Any], defines: Defines = ()) -> tuple[list[Any], int, int]:
        """Check arguments, and put those of the device's form and of a build in their order.

        Parameters
        ----------
        values : the arguments of both forms and of all builds by name.
        defines : the constants of the build.

        Returns
        -------
        The arguments, the number of work-items, in complete groups, and that of a group.

        Raises
        ------
        ShapeError : an argument is missing, unknown, or of a wrong type or shape.
        """
        if values.keys() != self.names:
            wrong = values.keys() ^ self.names
            raise ShapeError(f"{self}: missing or unknown arguments {sorted(wrong)}")
        return self.contract(device, defines).bind(device, values)

    def units(self, device: Device, **sizes: int) -> int:
        """The number of elements, work-items or groups of a launch with these sizes, by name."""
        return int(self.forms.of(device).units(device, sizes))


class Contract:
    """One form of a Kernel in builds with the same choices.

    Parameters
    ----------
    choices : the constants on which arguments depend and which are not 0.
    """

    def __init__(self, kernel: Kernel, launch: Launch, choices: frozenset[str]) -> None:
        self.kernel, self.launch = kernel, launch
        self.arguments: dict[str, Argument] = {
            name: argument.argument
            if isinstance(argument, Only)
            else argument.of(choices)
            if isinstance(argument, Either)
            else argument
            for name, argument in {**kernel.arguments, **launch.arguments}.items()
            if not isinstance(argument, Only) or argument.define in choices
        }
        # (name, dtype or None for the device's real, shape or None for a scalar)
        self._checks = [
            (name, None, None)
            if isinstance(a, str)
            else (name, None if a[0] == "real" else np.dtype(SCALARS[a[0]]), a[1:])
            for name, a in self.arguments.items()
        ]
        self._fixed = {n: n for _, _, shape in self._checks for n in shape or () if isinstance(n, int)}
        known = {name for name, a in self.arguments.items() if isinstance(a, str)}.union(
            DEVICE_SIZES, *(shape for _, _, shape in self._checks if shape)
        )
        self._units, self._group = (self._factors(text, known) for text in (launch.units, launch.group))

    def _factors(self, text: str, known: set[Any]) -> Factors:
        """The names or numbers and their divisors in a size; DeviceError for an unknown name."""
        factors = []
        for word in text.split():
            parts = [int(part) if part.isdigit() else SHARED.get(part, part) for part in (*word.split("/"), "1")]
            if unknown := [part for part in parts if isinstance(part, str) and part not in known]:
                raise DeviceError(f"{self.kernel}: '{unknown[0]}' of its launch is not an argument")
            factors.append((parts[0], parts[1]))
        return factors

    def bind(self, device: Device, values: Mapping[str, Any]) -> tuple[list[Any], int, int]:
        """As `Kernel.bind`, which has checked the names."""
        sizes: dict[Any, int] = self._fixed.copy()
        real, arguments = device.real, []
        for name, dtype, shape in self._checks:  # at every launch, so this must be fast
            value = values[name]
            if shape is None:
                sizes[name] = value
                arguments.append(value)
                continue
            if value.dtype != (dtype or real):
                raise ShapeError(f"{self.kernel}: '{name}' is {value.dtype}, expected {dtype or real}")
            fits = len(value.shape) == len(shape)
            for axis, length in zip(shape, value.shape):
                if sizes.setdefault(axis, length) != length:
                    fits = False
            if not fits:
                bound = {k: v for k, v in sizes.items() if isinstance(k, str)}
                raise ShapeError(f"{self.kernel}: '{name}' has shape {value.shape}, expected {shape} where {bound}")
            arguments.append(value.buffer)
        return arguments, *self._work(device, sizes)

    def units(self, device: Device, sizes: dict[Any, int]) -> int:
        """The same as `Kernel.units`; adds the sizes of the device to `sizes`."""
        for name, attribute in DEVICE_SIZES.items():
            sizes[name] = getattr(device, attribute)
        return _product(self._units, sizes)

    def _work(self, device: Device, sizes: dict[Any, int]) -> tuple[int, int]:
        """The number of work-items, in complete groups, and of those in a group."""
        units, group = self.units(device, sizes), _product(self._group, sizes)
        if self.launch.kind == "groups":
            return units * group, group
        if self.launch.kind == "each":
            if device.form == "item":
                return min(units, device.item_runs * device.compute_units), 1
            group = device.group_size
        return -(-units // group) * group, group

    def check_built(self, built: cl.Kernel) -> None:
        """Compare with the compiler's signature; DeviceError where arguments differ or are swapped."""
        if built.num_args != len(self.arguments):
            raise DeviceError(f"{self.kernel}: it has {built.num_args} arguments, {len(self.arguments)} are declared")
        try:
            found: list[tuple[Any, Any]] = [
                (
                    built.get_arg_info(index, cl.kernel_arg_info.NAME),
                    built.get_arg_info(index, cl.kernel_arg_info.TYPE_NAME),
                )
                for index in range(built.num_args)
            ]
        except cl.Error:  # a binary, or a driver that does not tell names
            return
        for index, ((actual, kind), (name, argument)) in enumerate(zip(found, self.arguments.items())):
            declared = argument if isinstance(argument, str) else argument[0] + "*"
            if actual != name or not _same_type(kind, declared):
                raise DeviceError(f"{self.kernel}: argument {index} is '{kind} {actual}', declared '{declared} {name}'")


def _product(factors: Factors, sizes: Mapping[Any, Any]) -> int:
    return math.prod(-(-sizes.get(size, size) // sizes.get(by, by)) for size, by in factors)


def _same_type(actual: str, declared: str) -> bool:
    """Whether the compiler's type name is the declared one; `real` stands for either precision."""
    actual = actual.replace(" ", "")
    for kind in ("int", "char", "short"):
        actual = actual.replace(f"unsigned{kind}", f"u{kind}")
    base, pointer = declared.rstrip("*"), declared.endswith("*")
    bases = ("float", "double", "real") if base == "real" else (base,)
    if pointer:  # wider loads of the same scalars are fine: float4* reads float rows
        return actual.endswith("*") and actual.rstrip("*").rstrip("0123456789") in bases
    return actual in bases
