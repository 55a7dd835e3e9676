"""Wall times of work on a device, and how benchmarks report them."""

import json
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from clsplat.device import Device

MULTIPLES = {"": 1, "k": 1_000, "M": 1_000_000}


@dataclass(frozen=True)
class Bench:
    """What a benchmark runs with, and its reports.

    Attributes
    ----------
    device : with profiling, if kernels are to be timed by the device's clock.
    gaussians : numbers of them, one after the other.
    repeats : times that are measured.
    as_json : whether reports are JSON lines in place of a table.
    """

    device: Device
    gaussians: tuple[int, ...]
    repeats: int = 20
    as_json: bool = False

    def milliseconds(self, function: Callable[[], object],
                     device: "Finishes | None" = None) -> NDArray[np.float64]:
        """Wall times float64[repeats] of `function()`, including its completion on the device."""
        return in_turn([(device or self.device, function)], self.repeats).ravel()

    def report(self, family: str, variant: str, times: NDArray[np.float64],
               size: Mapping[str, object]) -> None:
        """Print one result.

        Parameters
        ----------
        times : milliseconds.
        size : the numbers that say how large the task was, by name.
        """
        record = {"family": family, "variant": variant, "form": self.device.form,
                  "device": self.device.name, "driver": self.device.handle.driver_version,
                  "size": size, **spread(times)}
        if self.as_json:
            print(json.dumps(record), flush=True)
            return
        low, high = record["quartiles_ms"]
        extra = ", ".join(f"{what} {count:,}" if isinstance(count, int) else f"{what} {count}"
                          for what, count in size.items())
        print(f"{family:12} {variant:24} {record['median_ms']:9.3f} ms  ({low:.3f} to {high:.3f})  "
              f"{extra}", flush=True)


class Finishes(Protocol):
    """A device, or a renderer on one."""

    def finish(self) -> None:
        """Wait for all its work."""


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


def counts(text: str) -> tuple[int, ...]:
    """The numbers of a list, such as (200000, 1000000) for "200k,1M"."""
    parts = [re.fullmatch(r"(\d+(?:\.\d+)?)([kM]?)", part) for part in text.split(",")]
    if not all(parts):
        raise ValueError("not a list of counts; give one such as 200k,1M,4M")
    return tuple(round(float(part[1]) * MULTIPLES[part[2]]) for part in parts if part)
