"""Sizes of kernels that are faster on a device than those it has: `trials`, and `write_row`."""

import gc
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.bench.selftest import check
from clsplat.bench.step import prepared_for
from clsplat.device import Device, Forms
from clsplat.device.tuning import REPORTED, SIZES, read_rows
from clsplat.errors import DeviceError
from clsplat.estimate.trial_steps import SizedPhotos, TrialSteps, sampled, sized, spread_out
from clsplat.io.records import write_object
from clsplat.rendering.pipeline import Renderer
from clsplat.training.session import Session

USED = Forms(item=("item_runs", "scan_group"), group=("group_size", "scan_group", "tile", "bucket", "adjoint_waves"))
ALL = "all"  # in place of a size: the first sizes of a device and the last ones
VIEWS = 8  # of a turn
LEAST_GAIN = 0.02  # of the time, for which another size is taken
Turn = Callable[[], float]  # takes some steps, and returns the milliseconds of one


@dataclass(frozen=True)
class Trial:
    """Steps with old and new sizes, by turns."""

    name: str  # the size that is another one, or ALL
    # old, new: all sizes, as of `clsplat.device.tuning.tuning_of`
    old: dict[str, int]
    new: dict[str, int]
    # old_ms, new_ms: medians of a step
    old_ms: float = 0.0
    new_ms: float = 0.0
    # lower, median and upper one of new / old, turn by turn
    quartiles: tuple[float, float, float] = (1.0, 1.0, 1.0)
    failure: str = ""  # what the driver raised with the new sizes, or ""

    @property
    def faster(self) -> bool:
        """Whether the gain is more than the spread, and worth it."""
        return max(self.quartiles[1] + LEAST_GAIN, self.quartiles[2]) < 1

    def line(self) -> str:
        """A row of the table whose heading is HEADING."""
        sizes = "" if self.name == ALL else f"{self.old[self.name]} -> {self.new[self.name]}"
        begin = f"{self.name:14}{sizes:12}"
        if self.failure:
            return f"{begin}  fails: {self.failure}"
        low, median, high = self.quartiles
        return (
            f"{begin}{self.old_ms:9.3f}{self.new_ms:9.3f}{median:8.3f}  "
            f"{low:.3f} to {high:.3f}{'  faster' if self.faster else ''}"
        )


HEADING = f"{'size':14}{'old -> new':12}{'old ms':>9}{'new ms':>9}{'ratio':>8}  quartiles"


def trials(device: Device, begin: Callable[[Device], Turn], turns: int) -> Iterator[Trial]:
    """Try every legal value of one size after the other, and take each that is faster.

    The last trial is of ALL, if any was taken: it measures once more, as the best of many trials
    may have been lucky.

    Parameters
    ----------
    device : open with the first sizes.
    begin : begins the same steps on a device that is open.
    turns : of each trial.
    """
    best, seen = device, {_effective(device)}
    for name in USED.of(device):
        for value in SIZES[name]:
            other = Device(device.handle, form=device.form, tuning={**best.tuning, name: value})
            if _effective(other) in seen:
                continue
            seen.add(_effective(other))
            trial = _compared(name, best, other, begin, turns)
            yield trial
            if trial.faster:
                best = other
    if best is not device:
        yield _compared(ALL, device, best, begin, turns)


def _effective(device: Device) -> tuple[int, ...]:
    """The sizes that a device has, which may be less than those of the row."""
    return (device.item_runs, device.group_size, device.scan_group, device.tile, device.bucket, device.adjoint_group)


def _compared(name: str, old: Device, new: Device, begin: Callable[[Device], Turn], turns: int) -> Trial:
    """Steps begin anew on both, as a training changes what a step costs."""
    gc.collect()  # what the last trial left on its devices
    first = begin(old)
    first()
    try:
        second = begin(new)
        second()
    except Exception as error:  # a driver may raise anything, and that is the result
        return Trial(name, old.tuning, new.tuning, failure=" ".join(f"{type(error).__name__}: {error}".split())[:300])
    times = np.empty((turns, 2))
    for number in range(turns):  # each is the first one as often as the other
        for side in (0, 1) if number % 2 else (1, 0):
            times[number, side] = (first, second)[side]()
    low, median, high = np.percentile(times[:, 1] / times[:, 0], (25, 50, 75)).tolist()
    old_ms, new_ms = np.median(times, axis=0).tolist()
    return Trial(name, old.tuning, new.tuning, old_ms, new_ms, (low, median, high))


def steps_of(device: Device, scene: Path, count: int, **options: Any) -> Callable[[Device], Turn]:
    """Training steps of a scene for `trials`, on a few views.

    Parameters
    ----------
    device : measures how large gaussians are to be.
    count : gaussians, drawn from the points; 0: as many as these.
    options : of a training, such as downscale.
    """
    prepared = prepared_for(scene, **options)
    views = prepared.train_views
    chosen = spread_out(len(views), VIEWS)
    gaussians = sized(
        sampled(prepared.scene, count or len(prepared.scene.points), 3),
        Renderer(device, 0, prepared.near),
        [views[index].camera for index in chosen],
    )

    def begin(device: Device) -> Turn:
        trial = TrialSteps(Session(prepared, device, gaussians, SizedPhotos(device, views, 1.0)))
        steps = [trial.prepare(index) for index in chosen]

        def turn() -> float:
            start = time.perf_counter()
            for step in steps:
                step()
            trial.finish()
            return (time.perf_counter() - start) / len(steps) * 1e3

        return turn

    return begin


def write_row(path: Path, device: Device, sizes: dict[str, int]) -> None:
    """Write a row for devices that report what this one does, after a self-test with its sizes.

    The file's rows of other devices stay. DeviceError where the self-test fails.
    """
    failed = [line for line in check(Device(device.handle, tuning=sizes)) if not line[1]]
    if failed:
        raise DeviceError(
            f"{device.name}: the self-test fails with these sizes ({failed[0][0]}: "
            f"{failed[0][2]}), so {path} was not written; keep the present ones"
        )
    others = [row for row in rows_in(path) if {name: row.get(name) for name in REPORTED} != device.reported]
    write_object(path, {"rows": [{**device.reported, **sizes}, *others]})


def rows_in(path: Path) -> list[dict[str, Any]]:
    """The rows of a file that may not exist yet; InputError where it is another file."""
    return read_rows(path) if path.exists() else []
