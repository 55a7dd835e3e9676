"""The time and the device memory of steps, from a few real ones.

We model both as a + b * pixels + c * gaussians, with a, b and c fitted to trial steps at two levels
and two numbers of gaussians. Of the memory this is what a step needs beside the model and the
photos, whose sizes are known. Sums and maxima over the segments of the simulated schedule are those
of the run.
"""

import itertools
import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from clsplat.device import Device
from clsplat.estimate.trial_steps import (
    TrialSteps,
    sampled,
    sized,
    spread_out,
    trial_session,
)
from clsplat.gaussians import LEARNED, Gaussians
from clsplat.rendering.pipeline import Renderer
from clsplat.scene import View
from clsplat.schedule.plan import size_at
from clsplat.schedule.simulate import Segment
from clsplat.training.model import ENGINES, Model
from clsplat.training.photos import DEVICE_SHARE, at_level, photo_array
from clsplat.training.progress import SilentProgress
from clsplat.training.start.prepare import PreparedScene

TIMED_VIEWS = 8  # for steps in turn
COUNTED_VIEWS = 48  # of which that with most splats decides the memory of a frame
TIMED_SECONDS = 0.2  # least time of a measurement, in which steps do not wait for the device
REPEATS = 3  # of a measurement; the median counts
MOST_GROWTH = 4  # largest multiple of the initial gaussians in a trial step
MOST_GAUSSIANS = 200_000  # in a trial step
MOST_PIXELS = 2e6  # of an image in a trial step; larger images are extrapolated

TimedStep = tuple[float, float, float]  # pixels, gaussians, seconds


@dataclass(frozen=True)
class Memory:
    """Bytes of device memory.

    Attributes
    ----------
    total : the most, while the model grows.
    steps : the most after a step, which metrics.jsonl records.
    photos : photos of the level with most, which are part of it.
    resident : whether photos stay on the device at every level.
    model : parameters and moments at the end.
    """

    total: int
    steps: int
    photos: int
    resident: bool
    model: int


@dataclass(frozen=True)
class Trial:
    """Steps that were taken.

    Attributes
    ----------
    pixels : of an image, the mean.
    gaussians : number of gaussians.
    seconds : of a step; 0 if it was not timed.
    nbytes : device memory beside the model and the photos.
    """

    pixels: float
    gaussians: int
    seconds: float
    nbytes: int


def take_trials(device: Device, prepared: PreparedScene, gaussians: int,
                segments: Sequence[Segment], timed: bool = True,
                progress: SilentProgress | None = None) -> list[Trial]:
    """Take steps at the sizes of `tried_sizes`.

    Parameters
    ----------
    device, prepared : of the training.
    gaussians : initial number.
    segments : the simulated run.
    timed : whether to time the steps.
    progress : receives what is being done.
    """
    regularises = any(segment.regularises for segment in segments)
    trials = []
    for level, count in tried_sizes(prepared.train_views, gaussians, segments):
        if progress:
            progress.phase(f"planning: {'timing' if timed else 'taking'} steps at "
                           f"{size_at(level)}, {count:,} gaussians")
        trials.append(_take_trial(device, prepared, level, count, regularises, timed))
    return trials


def tried_sizes(views: Sequence[View], count: int,
                segments: Sequence[Segment]) -> list[tuple[float, int]]:
    """The (level, gaussians) of trial steps.

    These are the first and the last level of the run, each with `count` gaussians and with more.
    Two smaller sizes replace images of more than MOST_PIXELS; they show the growth with pixels.
    """
    few = min(count, MOST_GAUSSIANS // MOST_GROWTH)
    many = min(max(segments[-1].gaussians, 2 * few), MOST_GROWTH * few, MOST_GAUSSIANS)
    first, last = segments[0].level, segments[-1].level
    most_first = max(segment.gaussians for segment in segments if segment.level == first)
    smaller = math.sqrt(pixels(views, 1.0) / MOST_PIXELS)
    if smaller > last:
        first, last = max(first, 2 * smaller), smaller
    return sorted({(first, few), (first, min(many, most_first)), (last, few), (last, many)},
                  reverse=True)


def _take_trial(device: Device, prepared: PreparedScene, level: float, count: int,
                regularises: bool, timed: bool) -> Trial:
    views = prepared.train_views
    renderer = Renderer(device, 0, prepared.near, prepared.options.antialiased)
    shown = at_level(views, level)
    cameras = [shown[index].camera for index in spread_out(len(views), TIMED_VIEWS)]
    gaussians = sized(sampled(prepared.scene, count, prepared.options.sh_degree), renderer, cameras)
    most = _fullest(renderer, gaussians, shown)
    device.trim()
    before = device.memory_bytes
    trial = TrialSteps(trial_session(prepared, device, gaussians, level))
    # the fullest first, so that frames have room for all
    steps = [trial.prepare(index, regularises)
             for index in (most, *(spread_out(len(views), TIMED_VIEWS) if timed else ()))]
    for step in steps:  # compile kernels and fill the pool
        step()
    trial.finish()
    nbytes = (device.memory_bytes - before - trial.view_bytes
              - sum(_model_bytes(device, prepared, gaussians.rows, count)))
    turns, each = itertools.cycle(steps[1:]), [0.0]
    for _ in range(REPEATS if timed else 0):
        begin, taken = time.perf_counter(), 0
        while time.perf_counter() - begin < TIMED_SECONDS:
            next(turns)()
            taken += 1
        trial.finish()
        each.append((time.perf_counter() - begin) / taken)
    return Trial(pixels(views, level), count, float(np.median(each[1:] or each)), max(1, nbytes))


def _fullest(renderer: Renderer, gaussians: Gaussians, views: Sequence[View]) -> int:
    """The index of the view that sees most gaussians, of some evenly spaced ones."""
    rows = {name: renderer.device.upload(values) for name, values in gaussians.rows.items()}
    return max(spread_out(len(views), COUNTED_VIEWS), key=lambda index: renderer.count_splats(
        rows, renderer.pack(views[index].camera)))


def fitted(measured: Sequence[TimedStep]) -> NDArray[np.float64]:
    """Fit (a, b, c) >= 0 to [(pixels, gaussians, cost), ...], by relative errors.

    Images of a single size determine only a + b * pixels.
    """
    image, count, cost = np.array(measured, float).T
    columns = np.stack([np.ones_like(image), image / image.max(), count / count.max()], axis=1)
    solution: NDArray[np.float64] = nnls(columns / cost[:, None], np.ones_like(cost))[0]
    solution /= np.array([1, image.max(), count.max()])
    return solution


def predicted_seconds(measured: Sequence[TimedStep], views: Sequence[View],
                      segments: Sequence[Segment]) -> float:
    """Seconds of a run without evaluations, files and compilation, from steps that were timed."""
    sizes = {level: pixels(views, level) for level in {s.level for s in segments}}
    cost = fitted(measured)
    return float(sum(s.steps * np.dot(cost, (1, sizes[s.level], s.gaussians)) for s in segments))


def seconds_of_a_step(measured: Sequence[TimedStep], views: Sequence[View], segment: Segment
                      ) -> float:
    """Seconds of one step of a segment."""
    return predicted_seconds(measured, views, [replace(segment, steps=1)])


def pixels(views: Sequence[View], level: float) -> float:
    """Mean number of pixels of an image at a level."""
    return float(np.mean([v.camera.width * v.camera.height for v in at_level(views, level)]))


def predicted_memory(device: Device, prepared: PreparedScene, gaussians: Gaussians,
                     segments: Sequence[Segment], trials: Sequence[Trial]) -> Memory:
    """Predict the device memory of a training; DeviceError if an array would be too large.

    Parameters
    ----------
    device, prepared : of the training.
    gaussians : the initial ones.
    segments : the simulated run.
    trials : steps that were taken on this device.
    """
    cost = fitted([(trial.pixels, trial.gaussians, trial.nbytes) for trial in trials])
    views, rows, of_views = prepared.train_views, gaussians.rows, dict[float, ViewMemory]()
    total, steps, count = 0, 0, gaussians.count
    for segment in segments:
        if segment.level not in of_views:
            of_views[segment.level] = ViewMemory(device, prepared, segment.level)
        stays = of_views[segment.level].nbytes
        if segment.gaussians != count:
            old, new = (_model_bytes(device, prepared, rows, each)
                        for each in (count, segment.gaussians))
            # each array is replaced in turn
            growing = max(sum(new[:place + 1]) + sum(old[place:]) for place in range(len(new)))
            total, count = max(total, stays + growing), segment.gaussians
        frame = float(np.dot(cost, (1, pixels(views, segment.level), count)))
        steps = max(steps, stays + int(frame) + sum(_model_bytes(device, prepared, rows, count)))
    return Memory(max(total, steps), steps,
                  max(each.nbytes * each.resident for each in of_views.values()),
                  all(each.resident for each in of_views.values()),
                  sum(_model_bytes(device, prepared, rows, count)))


class ViewMemory:
    """Device bytes of what training views show at a level.

    Attributes
    ----------
    nbytes : of all photos; if they are read at each use, of the largest one.
    resident : whether the photos stay on the device.
    """

    def __init__(self, device: Device, prepared: PreparedScene, level: float) -> None:
        shown = at_level(prepared.train_views, level)
        sizes = [photo_array(view).nbytes(device.real) for view in shown]
        spare = DEVICE_SHARE * device.handle.global_mem_size - sum(sizes)
        self.resident = spare >= 0
        self.nbytes = sum(sizes) if self.resident else max(sizes)


def _model_bytes(device: Device, prepared: PreparedScene, names: Iterable[str], count: int
                 ) -> list[int]:
    """Bytes of the arrays of rows and moments, in the order in which growth replaces them."""
    options = prepared.options
    rows = Model.arrays(names, options.sh_degree, count)
    moments = ENGINES[options.engine].arrays({field.name: rows[field.name] for field in LEARNED})
    sizes = [spec.nbytes(device.real) for fields in (rows, *moments) for spec in fields.values()]
    for size in sizes:
        device.check_size(size)
    return sizes
