"""The time of a training: of its steps alone, and in all."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

from clsplat.device import Device


class Clock:
    """Measures time and counts the bytes of arrays passed to kernels; it starts at once."""

    def __init__(self, device: Device) -> None:
        self._device, self._started = device, time.perf_counter()
        self._train_seconds = self._wall_seconds = 0.0  # before the last pause; before a resume
        self._kernel_bytes = 0
        self.restart()

    def restart(self) -> None:
        """Exclude the time since the last pause from training."""
        self._since = time.perf_counter() - self._device.build_seconds
        self._bytes = self._device.kernel_bytes

    def add(self, seconds: float) -> None:
        """Count seconds that were spent before the first step as training."""
        self._train_seconds += seconds

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Exclude the time of the block from training."""
        self._device.finish()
        self._train_seconds, self._kernel_bytes = self.trained(), self.moved()
        yield
        self.restart()

    def trained(self) -> float:
        """Seconds of training so far, without the compilation of kernels."""
        return (self._train_seconds + time.perf_counter() - self._device.build_seconds
                - self._since)

    def moved(self) -> int:
        """Bytes of the arrays that training has passed to kernels, summed over launches."""
        return self._kernel_bytes + self._device.kernel_bytes - self._bytes

    def elapsed(self) -> float:
        """Wall seconds since the run began, including those before a resume."""
        return self._wall_seconds + time.perf_counter() - self._started

    def state(self) -> dict[str, float]:
        """State for a checkpoint, while paused."""
        return {"train_seconds": self._train_seconds, "wall_seconds": self.elapsed(),
                "kernel_bytes": self._kernel_bytes}

    def load(self, state: dict[str, float]) -> None:
        """Restore what `state` returned."""
        self._train_seconds, self._wall_seconds = state["train_seconds"], state["wall_seconds"]
        self._kernel_bytes = int(state["kernel_bytes"])
