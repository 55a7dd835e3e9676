"""The time that a training will take, from a few of its real steps.

A step is taken to cost a + b * pixels + c * gaussians; the three are fitted to steps at two levels
and two numbers of gaussians, and laid over the course that the schedule is expected to go.
"""

import itertools
import math
import os
import time
from dataclasses import replace

import numpy as np
from scipy.optimize import nnls

from clsplat.estimate.trial_steps import Rehearsal, sized, spread_out, strewn
from clsplat.rendering.pipeline import Renderer
from clsplat.training.photos import at_level, decode
from clsplat.training.silent import Silent

VIEWS = 8  # stepped with in turn
BATCH = 0.2  # seconds at least that are timed at once, as training goes: without waiting in between
BATCHES = 3  # whose median counts
MORE = 4  # times the initial gaussians, at most, are stepped with
MOST = 200_000
MOST_PIXELS = 2e6  # of an image that is stepped with; larger ones are extrapolated to
BUSY = 0.5  # processes that wait or run, a core


def predicted_seconds(device, scene, views, needs, gaussians, stretches, progress=None):
    """(seconds of training, [(level, gaussians, seconds a step), ...]: of the first stretch and of
    the last).

    Arguments as of `memory.predicted_memory`. Evaluations, files and compiling are no training.
    """
    progress, photos = progress or Silent(), {}

    def read(device, view):
        """A photo of the view's size: which one it is does not matter to the time."""
        size = view.camera.width, view.camera.height
        if size not in photos:
            photos[size] = decode(view)
        return device.upload(photos[size])

    regularises = any(stretch.regularises for stretch in stretches)
    measured = []
    for level, count in stepped_with(views, gaussians.count, stretches):
        progress.phase(f"planning: timing steps at level {level:.3g}, {count:,} gaussians")
        seconds = _step_seconds(device, scene, views, needs, level, count, regularises, read)
        measured.append((pixels(views, level), count, seconds))
    cost = fitted(measured)
    ends = [(s.level, s.gaussians, foretold(cost, views, [replace(s, steps=1)]))
            for s in (stretches[0], stretches[-1])]
    return foretold(cost, views, stretches), ends


def stepped_with(views, count, stretches):
    """[(level, gaussians), ...] to time steps at: those of the course's first level and of its
    last, of `count` gaussians and of more. Images of more than MOST_PIXELS are left out: two
    smaller sizes say how time grows with pixels."""
    few = min(count, MOST)
    many = min(max(stretches[-1].gaussians, 2 * few), MORE * few, MOST)
    first, last = stretches[0].level, stretches[-1].level
    most_first = max(stretch.gaussians for stretch in stretches if stretch.level == first)
    smaller = math.sqrt(pixels(views, 1.0) / MOST_PIXELS)
    if smaller > last:
        first, last = max(first, 2 * smaller), smaller
    return sorted({(first, few), (first, min(many, most_first)), (last, few), (last, many)},
                  reverse=True)


def load():
    """(processes that run or wait, cores) where the machine is busy with other things, by its
    average of the last minute; None where it is not, or does not tell."""
    try:
        average, cores = os.getloadavg()[0], os.cpu_count() or 1
    except (AttributeError, OSError):  # Windows has none
        return None
    return (average, cores) if average > BUSY * cores else None


def fitted(measured):
    """(a, b, c) >= 0 of [(pixels, gaussians, seconds), ...], equal relative errors weighing
    equally. Images of one size say only what a + b * pixels is."""
    image, count, seconds = np.array(measured, float).T
    columns = np.stack([np.ones_like(image), image / image.max(), count / count.max()], axis=1)
    solution, _ = nnls(columns / seconds[:, None], np.ones_like(seconds))
    return solution / [1, image.max(), count.max()]


def foretold(cost, views, stretches):
    """Seconds of a course by (a, b, c)."""
    sizes = {level: pixels(views, level) for level in {s.level for s in stretches}}
    return float(sum(s.steps * np.dot(cost, (1, sizes[s.level], s.gaussians)) for s in stretches))


def pixels(views, level):
    """Of an image, on average."""
    return float(np.mean([v.camera.width * v.camera.height for v in at_level(views, level)]))


def _step_seconds(device, scene, views, needs, level, count, regularises, read):
    """Seconds of a step on real photos."""
    options, chosen = needs.options, spread_out(len(views), VIEWS)
    renderer = Renderer(device, 0, options.near / scene.unit or scene.near_plane,
                        options.antialiased)
    cameras = [view.camera for view in at_level([views[index] for index in chosen], level)]
    rehearsal = Rehearsal(device, scene, views, needs,
                          sized(strewn(scene, count, options.sh_degree), renderer, cameras), read)
    rehearsal.use(level)
    steps = [rehearsal.prepare(index, regularises) for index in chosen]
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
