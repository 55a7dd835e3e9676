"""Launches that are recorded once and enqueued again with other inputs."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import pyopencl as cl
import pyopencl._cl

from clsplat.device.array import Array
from clsplat.errors import ShapeError

if TYPE_CHECKING:
    from clsplat.device.device import Device


def _enqueuer() -> Callable[..., int] | None:
    """clEnqueueNDRangeKernel of the library that pyopencl uses, or None where it cannot be found.

    pyopencl asks for an event of each launch. On NVIDIA's devices an event delays the next kernel
    by 3 us, and a step of 14 kernels by a twentieth.
    """
    try:
        function: Any = ctypes.CDLL(pyopencl._cl.__file__).clEnqueueNDRangeKernel
    except (OSError, AttributeError):  # Windows looks for it in the module alone
        return None
    pointer, number = ctypes.c_void_p, ctypes.c_uint
    function.argtypes = [pointer, pointer, number, *3 * [pointer], number, pointer, pointer]
    enqueue: Callable[..., int] = function
    return enqueue


_ENQUEUE = _enqueuer()


class Input:
    """A number of a recording that each replay may change: it can be passed to kernels. It is no
    number for Python, which would compute once with what a replay changes.

    Attributes
    ----------
    name : of the input.
    number : its value while it is recorded, for the launch.
    """

    __slots__ = "name", "number"

    def __init__(self, name: str, number: float) -> None:
        self.name, self.number = name, number

    def __repr__(self) -> str:
        return f"<input {self.name}>"

    def _refuse(self, *_: Any) -> Any:
        raise TypeError(f"a replay changes the number {self.name}: pass it to kernels as it is")

    # what every object can do; the rest Python refuses by itself
    __bool__ = __eq__ = __hash__ = __str__ = __format__ = __array__ = _refuse


class Graph:
    """What `Device.record` recorded: kernels with their arguments, and fills, in order.

    Parameters
    ----------
    device : of the launches.
    inputs : name -> an array or a number.

    Attributes
    ----------
    inputs : name -> what stands for an input while it is recorded.
    lasting : arrays that live as long as the graph.
    result : whatever the recorder wants to keep with it.
    """

    def __init__(self, device: Device, inputs: Mapping[str, Array | float]) -> None:
        self.device = device
        self.result: Any = None
        self.lasting: list[Array] = []
        self.inputs: dict[str, Any] = {
            name: value if isinstance(value, Array) else Input(name, value) for name, value in inputs.items()
        }
        self._names = {id(value.buffer): name for name, value in inputs.items() if isinstance(value, Array)}
        # (list of arguments, index) at which an input stands
        self._places: dict[str, list[tuple[list[Any], int]]] = {name: [] for name in inputs}
        # (function, kernel or None for a fill, items, items a group, arguments, which are kept as
        # kernels do not keep arrays alive, whether inputs are among these)
        self._commands: list[tuple[str, Any, Any, Any, list[Any], bool]] = []
        self._bound: list[tuple[Any, Any]] = []  # (kernel, the list of spare ones)

    def __del__(self) -> None:
        for kernel, spare in self._bound:
            spare.append(kernel)

    def add(self, function: str, kernel: Any, items: int, group: int, arguments: list[Any]) -> None:
        """Record a launch, or where `kernel` is None a fill of (buffer, value, bytes).

        Parameters
        ----------
        function : the name of the kernel.
        kernel : a built kernel.
        items, group : work-items of the launch and of a group.
        arguments : of the launch.
        """
        changes = False
        for index, argument in enumerate(arguments):
            name = self._names.get(id(argument))
            if isinstance(argument, Input):
                name, arguments[index] = argument.name, argument.number
            if name is not None:
                self._places[name].append((arguments, index))
                changes = True
        if kernel is not None:  # one of its own, in which arguments that stay are set once
            kernel, spare = self.device.spare_kernel(kernel)
            self._bound.append((kernel, spare))
            kernel.set_args(*arguments)
        self._commands.append(
            (function, kernel, (ctypes.c_size_t * 1)(items), (ctypes.c_size_t * 1)(group), arguments, changes)
        )

    def replay(self, **inputs: Array | float) -> None:
        """Enqueue all commands again.

        Parameters
        ----------
        inputs : new values of the inputs; an array must be of the shape and type of the recorded.

        Raises
        ------
        ShapeError : for an array of another shape or type.
        """
        for name, value in inputs.items():
            raw: Any = value
            if isinstance(value, Array):
                recorded = self.inputs[name]
                if not isinstance(recorded, Array) or (value.shape != recorded.shape or value.dtype != recorded.dtype):
                    raise ShapeError(f"input '{name}' has another shape or type than recorded")
                raw = value.buffer
            for arguments, index in self._places[name]:
                arguments[index] = raw
        device, queue = self.device, self.device.queue
        profile, pointer = device._profile, queue.int_ptr
        enqueue = _ENQUEUE if profile is None else None
        for function, kernel, items, group, arguments, changes in self._commands:
            if kernel is None:
                event = cl.enqueue_fill_buffer(queue, *arguments)
            else:
                if changes:
                    kernel.set_args(*arguments)
                if enqueue and not enqueue(pointer, kernel.int_ptr, 1, None, items, group, 0, None, None):
                    continue
                event = cl.enqueue_nd_range_kernel(queue, kernel, tuple(items), tuple(group))
            if profile is not None:
                profile.append((function, event))
        device.launches += len(self._commands)
