"""What a device does at most, measured by two kernels that do nothing else (ceilings.cl)."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from clsplat.device import Kernel

from .timing import milliseconds

FILE = str(Path(__file__).with_suffix(".cl"))
COPY = Kernel(FILE, "copy_reals", count="uint", source=("real", "N"), result=("real", "N"))
MULTIPLY_ADD = Kernel(FILE, "multiply_add", count="uint", rounds="uint", factors=("real", 2),
                      results=("real", "N"))
COPIED_BYTES = 128 << 20  # beyond any cache, unless the device cannot allocate as much
LEAST_MILLISECONDS = 20  # a launch costs little beside it


@dataclass(frozen=True)
class Ceilings:
    """copy: bytes read and written a second; arithmetic: operations a second."""

    copy: float
    arithmetic: float


def measure_ceilings(device, repeats=10):
    """The best of `repeats` runs of each: what disturbs only ever slows down."""
    return Ceilings(_copy(device, repeats), _multiply_add(device, repeats))


def _width(device):
    return 16 if device.form == "item" else 4


def _copy(device, repeats):
    row_bytes = _width(device) * device.real.itemsize
    count = min(COPIED_BYTES, device.largest_buffer // 4) // row_bytes
    source, result = (device.empty(count * _width(device)) for _ in range(2))
    source.fill(0)
    run = partial(device.launch_each, COPY, count, count=count, source=source, result=result)
    return 2 * count * row_bytes / (milliseconds(device, run, repeats).min() * 1e-3)


def _multiply_add(device, repeats):
    """Enough elements for every lane, and rounds until a launch takes long enough to be timed."""
    count = device.compute_units * (64 if device.form == "item" else 8192)
    factors = device.upload(np.array([0.5, 0.25]))
    results = device.empty(count * _width(device))
    rounds, fastest = 64, 0
    while fastest < LEAST_MILLISECONDS:
        rounds *= 2
        run = partial(device.launch_each, MULTIPLY_ADD, count, count=count, rounds=rounds,
                      factors=factors, results=results)
        fastest = milliseconds(device, run, 1, warm_up=1).min()
    return (16 * rounds * count * _width(device)
            / (milliseconds(device, run, repeats, warm_up=0).min() * 1e-3))
