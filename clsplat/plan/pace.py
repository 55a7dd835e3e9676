"""The time that a training will take, from a few of its real steps.

A step is taken to cost a + b * pixels + c * gaussians; the three are fitted to steps at two levels
and two numbers of gaussians, and laid over the course that the schedule is expected to go.
"""

import time

import numpy as np
from scipy.optimize import nnls

from clsplat.plan.rehearsal import Rehearsal, spread_out, strewn
from clsplat.train.photos import at_level, decode

STEPS = 4  # timed, after one that is not
MORE = 4  # times the initial gaussians, at most, are stepped with
MOST = 200_000
PRECIOUS = 2.0  # seconds for the steps of one size: a slow device takes fewer


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
    """The median of some steps' seconds on real photos."""
    rehearsal = Rehearsal(device, scene, views, needs,
                          strewn(scene, count, needs.options.sh_degree), _read)
    rehearsal.use(level)
    steps = [rehearsal.prepare(index, regularises) for index in spread_out(len(views), STEPS)]
    steps[0]()  # builds kernels and fills the pool
    device.finish()
    times, begin = [], time.perf_counter()
    for step in steps:
        before = time.perf_counter()
        step()
        device.finish()
        times.append(time.perf_counter() - before)
        if time.perf_counter() - begin > PRECIOUS:
            break
    return float(np.median(times))


def _read(device, view):
    return device.upload(decode(view))
