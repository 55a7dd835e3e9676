"""Launches that are recorded once and enqueued again with other inputs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pyopencl as cl

from clsplat.device.array import Array
from clsplat.errors import ShapeError

if TYPE_CHECKING:
    from clsplat.device.device import Device


class _AsItIs:
    """Without arithmetic, whose result a replay would not change."""

    def _refuse(self, *_: Any) -> Any:
        raise TypeError("a replay changes this number: pass it to kernels as it is")

    __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = __neg__ = _refuse
    __truediv__ = __rtruediv__ = __floordiv__ = __rfloordiv__ = __pow__ = __rpow__ = _refuse


class FloatInput(_AsItIs, float):
    """A number of a recording that each replay may change."""


class IntInput(_AsItIs, int):
    """As `FloatInput`, for integers."""


Input = Array | FloatInput | IntInput


class Graph:
    """What `Device.record` recorded: kernels with their arguments, and fills, in order.

    Parameters
    ----------
    device : of the launches.
    inputs : name -> what stands for an input while it is recorded.

    Attributes
    ----------
    result : whatever the recorder wants to keep with it.
    """

    def __init__(self, device: Device, inputs: dict[str, Input]) -> None:
        self.device, self.result = device, None
        self._inputs = inputs
        self._names = {id(value.buffer if isinstance(value, Array) else value): name
                       for name, value in inputs.items()}
        # (list of arguments, index) at which an input stands
        self._places: dict[str, list[tuple[list[Any], int]]] = {name: [] for name in inputs}
        self._commands: list[tuple[str, Any, int, int, list[Any]]] = []
        self._nbytes = 0

    def __len__(self) -> int:
        """The number of commands that a replay enqueues."""
        return len(self._commands)

    @property
    def functions(self) -> list[str]:
        """The kernels in their order; "fill" for a fill."""
        return [function for function, *_ in self._commands]

    def add(self, function: str, kernel: Any, items: int, group: int, arguments: list[Any],
            nbytes: int) -> None:
        """Record a launch, or a fill of (buffer, value, bytes) where `kernel` is None."""
        self._commands.append((function, kernel, items, group, arguments))
        self._nbytes += nbytes
        for index, argument in enumerate(arguments):
            name = self._names.get(id(argument))
            if name is not None:
                self._places[name].append((arguments, index))

    def replay(self, **inputs: Input | float) -> None:
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
                recorded = self._inputs[name]
                if not isinstance(recorded, Array) or (
                        value.shape != recorded.shape or value.dtype != recorded.dtype):
                    raise ShapeError(f"input '{name}' has another shape or type than recorded")
                raw = value.buffer
            for arguments, index in self._places[name]:
                arguments[index] = raw
        device, queue = self.device, self.device.queue
        profile = device._profile
        for function, kernel, items, group, arguments in self._commands:
            if kernel is None:
                event = cl.enqueue_fill_buffer(queue, *arguments)
            else:
                event = kernel(queue, (items,), (group,), *arguments)
            if profile is not None:
                profile.append((function, event))
        device.kernel_bytes += self._nbytes
        device.launches += len(self._commands)
