"""Peak rates of a device, measured by a kernel that only copies and one that only computes
(ceilings.cl)."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from clsplat.device import Device, Forms, Kernel, each

from .timing import milliseconds

FILE = str(Path(__file__).with_suffix(".cl"))
COPY = Kernel(FILE, "copy_reals", each("count"), count="uint", source=("real", "N"),
              result=("real", "N"))
MULTIPLY_ADD = Kernel(FILE, "multiply_add", each("count"), count="uint", rounds="uint",
                      factors=("real", 2), results=("real", "N"))
REALS_PER_ITEM = Forms(item=16, group=4)  # loaded at once by a work-item
ITEMS_PER_UNIT = Forms(item=64, group=8192)  # of a compute unit: enough for every lane
COPIED_BYTES = 128 << 20  # beyond any cache, unless the device cannot allocate as much
MIN_MILLISECONDS = 20  # of a measured launch: its overhead is small beside it


@dataclass(frozen=True)
class Ceilings:
    """Peak rates of a device.

    Attributes
    ----------
    copy : bytes read and written a second.
    arithmetic : operations a second.
    """

    copy: float
    arithmetic: float


def measure_ceilings(device: Device, repeats: int = 10) -> Ceilings:
    """The best of `repeats` runs of each kernel, since disturbances only make runs slower."""
    return Ceilings(_copy(device, repeats), _multiply_add(device, repeats))


def _copy(device: Device, repeats: int) -> float:
    row_bytes = REALS_PER_ITEM.of(device) * device.real.itemsize
    count = min(COPIED_BYTES, device.largest_buffer // 4) // row_bytes
    source, result = (device.empty(count * REALS_PER_ITEM.of(device)) for _ in range(2))
    source.fill(0)
    run = partial(device.launch, COPY, count=count, source=source, result=result)
    return float(2 * count * row_bytes / (milliseconds(device, run, repeats).min() * 1e-3))


def _multiply_add(device: Device, repeats: int) -> float:
    """Operations a second, with as many rounds as a launch needs to be timed."""
    count = device.compute_units * ITEMS_PER_UNIT.of(device)
    factors = device.upload(np.array([0.5, 0.25]))
    results = device.empty(count * REALS_PER_ITEM.of(device))
    rounds, fastest = 64, 0.0
    while fastest < MIN_MILLISECONDS:
        rounds *= 2
        run = partial(device.launch, MULTIPLY_ADD, count=count, rounds=rounds, factors=factors,
                      results=results)
        fastest = milliseconds(device, run, 1, warm_up=1).min()
    return float(16 * rounds * count * REALS_PER_ITEM.of(device)
                 / (milliseconds(device, run, repeats, warm_up=0).min() * 1e-3))
