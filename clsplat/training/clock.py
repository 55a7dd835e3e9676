"""Time of a training: of its steps alone, and of all."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

from clsplat.device import Device


class Clock:
    """Reads the time and counts the bytes that kernels are given; runs from its making."""

    def __init__(self, device: Device) -> None:
        self._device, self._started = device, time.perf_counter()
        self._train_seconds = self._wall_seconds = 0.0  # before the last pause; before a resume
        self._kernel_bytes = 0
        self._run()

    def _run(self):
        self._since = time.perf_counter() - self._device.build_seconds
        self._bytes = self._device.kernel_bytes

    def _pause(self):
        self._device.finish()
        self._train_seconds, self._kernel_bytes = self.trained(), self.moved()

    def restart(self) -> None:
        """What came since the last pause was no training."""
        self._run()

    @contextmanager
    def paused(self) -> Iterator[None]:
        """What happens in the block is no training."""
        self._pause()
        yield
        self._run()

    def trained(self) -> float:
        """Seconds of training so far, without those of compiling kernels."""
        return (self._train_seconds + time.perf_counter() - self._device.build_seconds
                - self._since)

    def moved(self) -> int:
        """Bytes of the arrays that training gave to kernels so far, once a launch."""
        return self._kernel_bytes + self._device.kernel_bytes - self._bytes

    def elapsed(self) -> float:
        """Wall seconds since the run began, those before a resume included."""
        return self._wall_seconds + time.perf_counter() - self._started

    def state(self) -> dict[str, float]:
        """What a checkpoint must hold, while paused."""
        return {"train_seconds": self._train_seconds, "wall_seconds": self.elapsed(),
                "kernel_bytes": self._kernel_bytes}

    def load(self, state: dict[str, float]) -> None:
        """Go on from the `state` that a checkpoint held."""
        self._train_seconds, self._wall_seconds = state["train_seconds"], state["wall_seconds"]
        self._kernel_bytes = int(state["kernel_bytes"])
