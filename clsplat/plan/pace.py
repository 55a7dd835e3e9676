"""The time that a training will take, from a few of its real steps.

A step is taken to cost a + b * pixels + c * gaussians; the three are fitted to steps at two levels
and two numbers of gaussians, and laid over the course that the schedule is expected to go.
"""

import itertools
import time

import numpy as np
from scipy.optimize import nnls

from clsplat.plan.rehearsal import Rehearsal, sized, spread_out, strewn
from clsplat.render.pipeline import Renderer
from clsplat.train.photos import at_level, decode

VIEWS = 8  # stepped with in turn
BATCH = 0.2  # seconds at least that are timed at once, as training goes: without waiting in between
BATCHES = 3  # whose median counts
MORE = 4  # times the initial gaussians, at most, are stepped with
MOST = 200_000


def predicted_seconds(device, scene, views, needs, gaussians, stretches):
    """(seconds of training, [(level, gaussians, seconds a step), ...] as measured).

    Arguments as of `memory.predicted_memory`. Evaluations, files and compiling are no training.
    """
    end = stretches[-1].gaussians
    few = min(gaussians.count, MOST)
    many = min(max(end, 2 * few), MORE * few, MOST)
    first, last = stretches[0].level, stretches[-1].level
    most_first = max(stretch.gaussians for stretch in stretches if stretch.level == first)
    sizes = {(first, few), (first, min(many, most_first)), (last, few), (last, many)}
    regularises = any(stretch.regularises for stretch in stretches)
    measured = [(*size, _step_seconds(device, scene, views, needs, *size, regularises))
                for size in sorted(sizes, reverse=True)]
    cost = fitted([(pixels(views, level), count, seconds) for level, count, seconds in measured])
    return foretold(cost, views, stretches), measured


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


def _step_seconds(device, scene, views, needs, level, count, regularises):
    """Seconds of a step on real photos."""
    options, chosen = needs.options, spread_out(len(views), VIEWS)
    renderer = Renderer(device, 0, options.near / scene.unit or scene.near_plane,
                        options.antialiased)
    cameras = [view.camera for view in at_level([views[index] for index in chosen], level)]
    rehearsal = Rehearsal(device, scene, views, needs,
                          sized(strewn(scene, count, options.sh_degree), renderer, cameras), _read)
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


def _read(device, view):
    return device.upload(decode(view))
