"""What a device does at most, measured by two kernels that do nothing else (ceilings.cl)."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from clsplat.device import Forms, Kernel, each

from .timing import milliseconds

FILE = str(Path(__file__).with_suffix(".cl"))
COPY = Kernel(FILE, "copy_reals", each("count"), count="uint", source=("real", "N"),
              result=("real", "N"))
MULTIPLY_ADD = Kernel(FILE, "multiply_add", each("count"), count="uint", rounds="uint",
                      factors=("real", 2), results=("real", "N"))
WIDTH = Forms(item=16, group=4)  # reals that a work-item loads at once
ELEMENTS = Forms(item=64, group=8192)  # a compute unit: enough for every lane
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


def _copy(device, repeats):
    row_bytes = WIDTH.of(device) * device.real.itemsize
    count = min(COPIED_BYTES, device.largest_buffer // 4) // row_bytes
    source, result = (device.empty(count * WIDTH.of(device)) for _ in range(2))
    source.fill(0)
    run = partial(device.launch, COPY, count=count, source=source, result=result)
    return 2 * count * row_bytes / (milliseconds(device, run, repeats).min() * 1e-3)


def _multiply_add(device, repeats):
    """Rounds until a launch takes long enough to be timed."""
    count = device.compute_units * ELEMENTS.of(device)
    factors = device.upload(np.array([0.5, 0.25]))
    results = device.empty(count * WIDTH.of(device))
    rounds, fastest = 64, 0
    while fastest < LEAST_MILLISECONDS:
        rounds *= 2
        run = partial(device.launch, MULTIPLY_ADD, count=count, rounds=rounds, factors=factors,
                      results=results)
        fastest = milliseconds(device, run, 1, warm_up=1).min()
    return (16 * rounds * count * WIDTH.of(device)
            / (milliseconds(device, run, repeats, warm_up=0).min() * 1e-3))
