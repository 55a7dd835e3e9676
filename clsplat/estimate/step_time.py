"""Predicts the time of a training from a few real steps.

We model the time of a step as a + b * pixels + c * gaussians, fit a, b and c to steps at two levels
and two numbers of gaussians, and sum over the segments of the simulated schedule.
"""

import itertools
import math
import os
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from clsplat.device import Device
from clsplat.estimate.trial_steps import TrialSteps, sampled, sized, spread_out, trial_session
from clsplat.gaussians import Gaussians
from clsplat.rendering.pipeline import Renderer
from clsplat.scene import View
from clsplat.schedule.plan import size_at
from clsplat.schedule.simulate import Segment
from clsplat.training.photos import at_level
from clsplat.training.prepare import PreparedScene
from clsplat.training.progress import SilentProgress

SAMPLED_VIEWS = 8  # for steps in turn
TIMED_SECONDS = 0.2  # least time of a measurement, in which steps do not wait for the device
REPEATS = 3  # of a measurement; the median counts
MOST_GROWTH = 4  # largest multiple of the initial gaussians in a timed step
MOST_GAUSSIANS = 200_000  # in a timed step
MOST_PIXELS = 2e6  # of an image in a timed step; larger images are extrapolated
BUSY_LOAD = 0.5  # processes per core that run or wait


def predicted_seconds(device: Device, prepared: PreparedScene, gaussians: Gaussians,
                      segments: Sequence[Segment], progress: SilentProgress | None = None,
                      known: Sequence[tuple[float, float, float]] = (),
                      ) -> tuple[float, list[tuple[float, int, float]],
                                 list[tuple[float, float, float]]]:
    """Predict the time of a training, without evaluations, files and compilation.

    Parameters
    ----------
    device, prepared, gaussians, segments : as for `memory.predicted_memory`.
    progress : receives what is being timed.
    known : [(pixels, gaussians, seconds of a step), ...] of another device, which counts; empty:
        steps are timed on this one.

    Returns
    -------
    (seconds, [(level, gaussians, seconds per step), ...] of the first and of the last segment,
    steps like `known` on which this rests).
    """
    progress, views = progress or SilentProgress(), prepared.train_views
    regularises = any(segment.regularises for segment in segments)
    measured = list(known)
    for level, count in () if known else stepped_with(views, gaussians.count, segments):
        progress.phase(f"planning: timing steps at {size_at(level)}, {count:,} gaussians")
        seconds = _step_seconds(device, prepared, level, count, regularises)
        measured.append((pixels(views, level), count, seconds))
    cost = fitted(measured)
    ends = [(s.level, s.gaussians, predicted(cost, views, [replace(s, steps=1)]))
            for s in (segments[0], segments[-1])]
    return predicted(cost, views, segments), ends, measured


def stepped_with(views: Sequence[View], count: int,
                 segments: Sequence[Segment]) -> list[tuple[float, int]]:
    """The (level, gaussians) at which steps are timed.

    These are the first and the last level of the run, each with `count` gaussians and with more.
    Two smaller sizes replace images of more than MOST_PIXELS; they show how time grows with pixels.
    """
    few = min(count, MOST_GAUSSIANS)
    many = min(max(segments[-1].gaussians, 2 * few), MOST_GROWTH * few, MOST_GAUSSIANS)
    first, last = segments[0].level, segments[-1].level
    most_first = max(segment.gaussians for segment in segments if segment.level == first)
    smaller = math.sqrt(pixels(views, 1.0) / MOST_PIXELS)
    if smaller > last:
        first, last = max(first, 2 * smaller), smaller
    return sorted({(first, few), (first, min(many, most_first)), (last, few), (last, many)},
                  reverse=True)


def load() -> tuple[float, int] | None:
    """(processes that run or wait, cores) if other processes keep the machine busy, else None.

    The number of processes is the average of the last minute; None too where it is not known.
    """
    try:
        average, cores = os.getloadavg()[0], os.cpu_count() or 1
    except (AttributeError, OSError):  # Windows has none
        return None
    return (average, cores) if average > BUSY_LOAD * cores else None


def fitted(measured: Sequence[tuple[float, float, float]]) -> NDArray[np.float64]:
    """Fit (a, b, c) >= 0 to [(pixels, gaussians, seconds), ...], by relative errors.

    Images of a single size determine only a + b * pixels.
    """
    image, count, seconds = np.array(measured, float).T
    columns = np.stack([np.ones_like(image), image / image.max(), count / count.max()], axis=1)
    solution: NDArray[np.float64] = nnls(columns / seconds[:, None], np.ones_like(seconds))[0]
    solution /= np.array([1, image.max(), count.max()])
    return solution


def predicted(cost: Sequence[float] | NDArray[np.float64], views: Sequence[View],
              segments: Sequence[Segment]) -> float:
    """Seconds of a run, from the cost (a, b, c)."""
    sizes = {level: pixels(views, level) for level in {s.level for s in segments}}
    return float(sum(s.steps * np.dot(cost, (1, sizes[s.level], s.gaussians)) for s in segments))


def pixels(views: Sequence[View], level: float) -> float:
    """Mean number of pixels of an image at a level."""
    return float(np.mean([v.camera.width * v.camera.height for v in at_level(views, level)]))


def _step_seconds(device: Device, prepared: PreparedScene, level: float, count: int,
                  regularises: bool) -> float:
    """Measure the seconds of a step on real photos."""
    chosen = spread_out(len(prepared.train_views), SAMPLED_VIEWS)
    renderer = Renderer(device, 0, prepared.near, prepared.options.antialiased)
    cameras = [view.camera
               for view in at_level([prepared.train_views[index] for index in chosen], level)]
    gaussians = sized(sampled(prepared.scene, count, prepared.options.sh_degree), renderer, cameras)
    trial = TrialSteps(trial_session(prepared, device, gaussians, level))
    steps = [trial.prepare(index, regularises) for index in chosen]
    for step in steps:  # compile kernels and fill the pool
        step()
    trial.finish()
    turns, each = itertools.cycle(steps), []
    for _ in range(REPEATS):
        begin, taken = time.perf_counter(), 0
        while time.perf_counter() - begin < TIMED_SECONDS:
            next(turns)()
            taken += 1
        trial.finish()
        each.append((time.perf_counter() - begin) / taken)
    return float(np.median(each))
