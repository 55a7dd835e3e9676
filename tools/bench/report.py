"""Reports of benchmarks, and what they run with."""

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from clsplat.device import Device
from tools.bench.timing import in_turn, spread

MULTIPLES = {"": 1, "k": 1_000, "M": 1_000_000}
Cases = Mapping[str, Callable[[], object]]  # variant -> what is timed


def counts(text: str) -> tuple[int, ...]:
    """The numbers of a list, such as (200000, 1000000) for "200k,1M"."""
    parts = [re.fullmatch(r"(\d+(?:\.\d+)?)([kM]?)", part) for part in text.split(",")]
    if not all(parts):
        raise ValueError("not a list of counts such as 200k,1M,4M")
    return tuple(round(float(part[1]) * MULTIPLES[part[2]]) for part in parts)


@dataclass(frozen=True)
class Bench:
    """What a benchmark runs with, and its reports."""

    device: Device
    gaussians: tuple[int, ...]
    repeats: int
    as_json: bool

    def report(
        self, family: str, variant: str, function: Callable[[], object], size: Mapping[str, Any], task: Any = None
    ) -> None:
        """Time a function of the device, or of a task that finishes, and print the result."""
        times = spread(in_turn([(task or self.device, function)], self.repeats)[0])
        if self.as_json:
            print(
                json.dumps(
                    {
                        "family": family,
                        "variant": variant,
                        "form": self.device.form,
                        "device": self.device.name,
                        "driver": self.device.handle.driver_version,
                        "size": size,
                        **times,
                    }
                ),
                flush=True,
            )
            return
        low, high = times["quartiles_ms"]
        print(
            f"{family:12} {variant:24} {times['median_ms']:9.3f} ms  ({low:.3f} to {high:.3f})  "
            + ", ".join(f"{what} {count:,}" for what, count in size.items()),
            flush=True,
        )
