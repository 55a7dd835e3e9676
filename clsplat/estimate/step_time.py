"""The time that a training will take, from a few of its real steps.

A step is taken to cost a + b * pixels + c * gaussians; the three are fitted to steps at two levels
and two numbers of gaussians, and added up over the segments of the simulated schedule.
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
from clsplat.schedule.simulate import Segment
from clsplat.training.photos import at_level
from clsplat.training.progress import SilentProgress
from clsplat.training.session import PreparedScene

VIEWS = 8  # stepped with in turn
BATCH = 0.2  # seconds at least that are timed at once, as training goes: without waiting in between
BATCHES = 3  # whose median counts
MORE = 4  # times the initial gaussians, at most, are stepped with
MOST = 200_000
MOST_PIXELS = 2e6  # of an image that is stepped with; larger ones are extrapolated to
BUSY = 0.5  # processes that wait or run, a core


def predicted_seconds(device: Device, prepared: PreparedScene, gaussians: Gaussians,
                      segments: Sequence[Segment], progress: SilentProgress | None = None,
                      ) -> tuple[float, list[tuple[float, int, float]]]:
    """(seconds of training, [(level, gaussians, seconds a step), ...]: of the first segment and of
    the last).

    Arguments as of `memory.predicted_memory`. Evaluations, files and compiling are no training.
    """
    progress, views = progress or SilentProgress(), prepared.train_views
    regularises = any(segment.regularises for segment in segments)
    measured = []
    for level, count in stepped_with(views, gaussians.count, segments):
        progress.phase(f"planning: timing steps at level {level:.3g}, {count:,} gaussians")
        seconds = _step_seconds(device, prepared, level, count, regularises)
        measured.append((pixels(views, level), count, seconds))
    cost = fitted(measured)
    ends = [(s.level, s.gaussians, predicted(cost, views, [replace(s, steps=1)]))
            for s in (segments[0], segments[-1])]
    return predicted(cost, views, segments), ends


def stepped_with(views: Sequence[View], count: int,
                 segments: Sequence[Segment]) -> list[tuple[float, int]]:
    """[(level, gaussians), ...] to time steps at: those of the run's first level and of its
    last, of `count` gaussians and of more. Images of more than MOST_PIXELS are left out: two
    smaller sizes say how time grows with pixels."""
    few = min(count, MOST)
    many = min(max(segments[-1].gaussians, 2 * few), MORE * few, MOST)
    first, last = segments[0].level, segments[-1].level
    most_first = max(segment.gaussians for segment in segments if segment.level == first)
    smaller = math.sqrt(pixels(views, 1.0) / MOST_PIXELS)
    if smaller > last:
        first, last = max(first, 2 * smaller), smaller
    return sorted({(first, few), (first, min(many, most_first)), (last, few), (last, many)},
                  reverse=True)


def load() -> tuple[float, int] | None:
    """(processes that run or wait, cores) where the machine is busy with other things, by its
    average of the last minute; None where it is not, or does not tell."""
    try:
        average, cores = os.getloadavg()[0], os.cpu_count() or 1
    except (AttributeError, OSError):  # Windows has none
        return None
    return (average, cores) if average > BUSY * cores else None


def fitted(measured: Sequence[tuple[float, int, float]]) -> NDArray[np.float64]:
    """(a, b, c) >= 0 of [(pixels, gaussians, seconds), ...], equal relative errors weighing
    equally. Images of one size say only what a + b * pixels is."""
    image, count, seconds = np.array(measured, float).T
    columns = np.stack([np.ones_like(image), image / image.max(), count / count.max()], axis=1)
    solution, _ = nnls(columns / seconds[:, None], np.ones_like(seconds))
    return solution / [1, image.max(), count.max()]


def predicted(cost: Sequence[float], views: Sequence[View],
              segments: Sequence[Segment]) -> float:
    """Seconds of a run by (a, b, c)."""
    sizes = {level: pixels(views, level) for level in {s.level for s in segments}}
    return float(sum(s.steps * np.dot(cost, (1, sizes[s.level], s.gaussians)) for s in segments))


def pixels(views: Sequence[View], level: float) -> float:
    """Of an image, on average."""
    return float(np.mean([v.camera.width * v.camera.height for v in at_level(views, level)]))


def _step_seconds(device, prepared, level, count, regularises):
    """Seconds of a step on real photos."""
    chosen = spread_out(len(prepared.train_views), VIEWS)
    renderer = Renderer(device, 0, prepared.near, prepared.options.antialiased)
    cameras = [view.camera
               for view in at_level([prepared.train_views[index] for index in chosen], level)]
    gaussians = sized(sampled(prepared.scene, count, prepared.options.sh_degree), renderer, cameras)
    trial = TrialSteps(trial_session(prepared, device, gaussians, level))
    steps = [trial.prepare(index, regularises) for index in chosen]
    for step in steps:  # builds kernels and fills the pool
        step()
    device.finish()
    turns, each = itertools.cycle(steps), []
    for _ in range(BATCHES):
        begin, taken = time.perf_counter(), 0
        while time.perf_counter() - begin < BATCH:
            next(turns)()
            taken += 1
        device.finish()
        each.append((time.perf_counter() - begin) / taken)
    return float(np.median(each))
