"""Wall times of work on a device."""

import time
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray


class Finishes(Protocol):
    """A device, or a renderer on one."""

    def finish(self) -> None:
        """Wait for all its work."""


def milliseconds(device: Finishes, function: Callable[[], object], repeats: int,
                 warm_up: int = 3) -> NDArray[np.float64]:
    """Wall times float64[repeats] of `function()` including its completion on the device."""
    return in_turn([(device, function)], repeats, warm_up).ravel()


def in_turn(tasks: Sequence[tuple[Finishes, Callable[[], object]]], repeats: int,
            warm_up: int = 3) -> NDArray[np.float64]:
    """Wall times float64[len(tasks), repeats] of several functions on their devices, one after the
    other in each round, so that other work on the machine disturbs all of them alike."""
    times = np.empty((len(tasks), warm_up + repeats))
    for turn in range(warm_up + repeats):
        for number, (device, function) in enumerate(tasks):
            start = time.perf_counter()
            function()
            device.finish()
            times[number, turn] = (time.perf_counter() - start) * 1e3
    return times[:, warm_up:]


def spread(times: NDArray[np.float64]) -> dict[str, Any]:
    """The fields median_ms, quartiles_ms (lower, upper) and repeats of a record."""
    low, median, high = np.percentile(times, (25, 50, 75))
    return {"median_ms": round(float(median), 4),
            "quartiles_ms": [round(float(low), 4), round(float(high), 4)], "repeats": len(times)}
