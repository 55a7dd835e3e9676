"""A kernel and its contract: what it is called with, checked when it is built and launched."""

import numpy as np
import pyopencl as cl

from clsplat.errors import DeviceError, ShapeError

SCALARS = {
    "int": np.int32, "uint": np.uint32, "ulong": np.uint64, "float": np.float32, "uchar": np.uint8}


class Kernel:
    """One kernel function: Kernel(file, function, count="uint", points=("real", "N", 3), ...).

    Arguments in the order of the OpenCL signature. A string is a scalar of that type; a tuple is
    an array: its type, then its shape, where equal letters must agree. `real` is float, or double
    on a device opened for double precision.
    """

    declared = {}  # file -> its kernels, as far as their modules were imported

    def __init__(self, file, function, **arguments):
        self.file, self.function, self.arguments = file, function, arguments
        self.declared.setdefault(file, []).append(self)
        self.signature = repr((function, *arguments.items()))
        # (name, dtype or None for the device's real, shape or None for a scalar)
        self._contract = [
            (name, None, None) if isinstance(a, str) else
            (name, None if a[0] == "real" else np.dtype(SCALARS[a[0]]), a[1:])
            for name, a in arguments.items()]
        self._fixed = {n: n for _, _, shape in self._contract for n in shape or ()
                       if isinstance(n, int)}

    def __repr__(self):
        return f"{self.function} in {self.file}"

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

    def checked(self, real, values):
        """(arguments in their order, arrays as buffers; bytes of the arrays). ShapeError names the
        argument whose type or shape is wrong; equal letters must be equal lengths."""
        if values.keys() != self.arguments.keys():
            wrong = values.keys() ^ self.arguments.keys()
            raise ShapeError(f"{self}: missing or unknown arguments {sorted(wrong)}")
        lengths, arguments, size = self._fixed.copy(), [], 0
        for name, dtype, shape in self._contract:  # every launch comes by: no step to spare
            value = values[name]
            if shape is None:
                arguments.append(value)
                continue
            if value.dtype != (dtype or real):
                raise ShapeError(f"{self}: '{name}' is {value.dtype}, wants {dtype or real}")
            fits = len(value.shape) == len(shape)
            for wanted, length in zip(shape, value.shape):
                if lengths.setdefault(wanted, length) != length:
                    fits = False
            if not fits:
                bound = {k: v for k, v in lengths.items() if isinstance(k, str)}
                raise ShapeError(f"{self}: '{name}' has shape {value.shape}, wants {shape} "
                                 f"where {bound}")
            arguments.append(value.buffer)
            size += value.nbytes
        return arguments, size


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
