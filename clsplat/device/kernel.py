"""A kernel and its contract: what it is called with, checked when it is built and launched."""

import numpy as np
import pyopencl as cl

from clsplat.errors import DeviceError, ShapeError

SCALARS = {
    "int": np.int32, "uint": np.uint32, "ulong": np.uint64, "float": np.float32, "uchar": np.uint8}


class Kernel:
    """One kernel function: Kernel(file, function, count="uint", points=("real", "N", 3), ...).

    Arguments in the order of the OpenCL signature. A string is a scalar of that type; a tuple is
    an array: its type, then its shape, where equal letters must agree and a trailing "..." allows
    any further axes. `real` is float, or double on a device opened for double precision. A scalar
    may bind a letter by carrying its name: count=("uint", "N") equals the length of the others.
    """

    def __init__(self, file, function, **arguments):
        self.file, self.function, self.arguments = file, function, arguments
        self.names = tuple(arguments)
        self.is_array = {n: not isinstance(a, str) for n, a in arguments.items()}

    def __repr__(self):
        return f"{self.function} in {self.file}"

    def check_built(self, built):
        """Compare with the compiler's own signature, so that no two arguments can be swapped."""
        if built.num_args != len(self.names):
            raise DeviceError(
                f"{self}: takes {built.num_args} arguments, {len(self.names)} declared")
        for index, (name, argument) in enumerate(self.arguments.items()):
            actual, kind = _signature(built, index)
            if actual is None:  # a driver that withholds names
                return
            wanted = argument if isinstance(argument, str) else argument[0] + "*"
            if actual != name or not _same_type(kind, wanted):
                raise DeviceError(
                    f"{self}: argument {index} is '{kind} {actual}', declared '{wanted} {name}'")

    def check_call(self, real, values):
        """Bind letters to lengths over all arrays; ShapeError names the argument that disagrees."""
        if values.keys() != self.arguments.keys():
            wrong = values.keys() ^ self.arguments.keys()
            raise ShapeError(f"{self}: missing or unknown arguments {sorted(wrong)}")
        lengths = {}
        for name, argument in self.arguments.items():
            if not self.is_array[name]:
                continue
            value = values[name]
            dtype = real if argument[0] == "real" else SCALARS[argument[0]]
            shape = argument[1:]
            if value.dtype != dtype:
                raise ShapeError(f"{self}: '{name}' is {value.dtype}, wants {np.dtype(dtype)}")
            actual = value.shape
            fits = len(actual) == len(shape)
            for wanted, length in zip(shape, actual):
                if isinstance(wanted, str):
                    wanted = lengths.setdefault(wanted, length)
                fits = fits and wanted == length
            if not fits:
                raise ShapeError(f"{self}: '{name}' has shape {actual}, wants {shape} "
                                 f"where {lengths}")


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
