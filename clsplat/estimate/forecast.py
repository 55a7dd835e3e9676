"""Forecasts the memory and time of a training.

The time and the device memory of a step are modelled as a + b * pixels + c * gaussians, with a, b
and c fitted to trial steps at two levels and two numbers of gaussians. Of the memory this is what a
step needs beside the model and the photos, whose sizes are known. Sums and maxima over the segments
of the simulated schedule are those of the run.
"""

import functools
import itertools
import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.device import Device, Forms
from clsplat.estimate.trial_steps import SizedPhotos, TrialSteps, sampled, sized, spread_out
from clsplat.gaussians import LEARNED
from clsplat.options import seconds_of
from clsplat.rendering.pipeline import Renderer
from clsplat.scene import View
from clsplat.schedule.plan import size_at
from clsplat.schedule.simulate import Segment, largest, simulate
from clsplat.schedule.steps import laid_over
from clsplat.training import photos as photo_store
from clsplat.training.model import ENGINES, Model, is_pageable, paged_arrays
from clsplat.training.photos import SMALL_SIDE, at_level, decoded, with_side
from clsplat.training.progress import SilentProgress
from clsplat.training.session import Session
from clsplat.training.start.initialise import initial_gaussians, start_seconds
from clsplat.training.start.prepare import PreparedScene

MIB = 2**20
TIMED_VIEWS = 8  # for steps in turn
COUNTED_VIEWS = 48  # of which that with most splats decides the memory of a frame
TIMED_SECONDS = 0.2  # least time of a measurement, in which steps do not wait for the device
REPEATS = 3  # of a measurement; the median counts
MOST_GROWTH = 4  # largest multiple of the initial gaussians in a trial step
MOST_GAUSSIANS = Forms(item=200_000, group=4_000_000)  # in a trial step: fewer do not fill a GPU
MOST_SAMPLED = 100_000  # dense points that stand for all of them
MOST_PIXELS = 2e6  # of an image in a trial step; larger images are extrapolated
DETAIL_VIEWS = 8  # of whose photos the detail is measured
DENSE_A_PIXEL = 1.6  # points, of the photos as they are searched for them: 1.4 and 2.0 on two sets


@dataclass(frozen=True)
class Memory:
    """Bytes of device memory."""

    total: int  # the most, while the model grows
    steps: int  # the most after a step, which metrics.jsonl records
    photos: int  # photos of the level with most, which are part of it
    resident: bool  # whether photos stay on the device at every level
    model: int  # parameters and moments at the end
    # harmonics and their moments, in host memory and not on the device where all do not fit; 0: all
    # fit
    waits: int = 0


@dataclass(frozen=True, eq=False)
class Forecast:
    """The predicted course of a training."""

    steps: int  # length of the run
    gaussians: int  # largest number of gaussians
    memory: Memory  # device memory
    seconds: float  # time of training
    # (level, gaussians, seconds per step) at the beginning and at the end of the run
    ends: list[tuple[float, int, float]]
    photos: str  # a sentence about whether photos stay on the device


def forecast(prepared: PreparedScene, device: Device, progress: SilentProgress | None = None) -> Forecast:
    """Forecast a training; this takes some real steps on the device.

    Raises DeviceError where these steps, or those to come, do not fit the device.
    """
    progress = progress or SilentProgress()
    options, scene, views = prepared.options, prepared.scene, prepared.train_views
    if options.init == "dense":
        count = _dense_count(prepared)
        gaussians = sampled(scene, min(count, MOST_SAMPLED), options.sh_degree)
    else:
        gaussians = initial_gaussians(scene, options)
        count = gaussians.count
    detail = functools.cache(functools.partial(photo_detail, views))
    progress.phase("planning: how many gaussians")
    segments = simulate(prepared.schedule(gaussians, options, count), detail)
    trials = take_trials(device, prepared, count, segments, progress)
    seconds = predicted_seconds(trials, views, segments)
    ends = [
        (segment.level, segment.gaussians, predicted_seconds(trials, views, [replace(segment, steps=1)]))
        for segment in (segments[0], segments[-1])
    ]
    progress.phase("planning: timing the search for dense points")
    seconds += start_seconds(device, prepared)
    if options.time_budget:
        budget = seconds_of(options.time_budget)
        options = laid_over(options, max(1, int(options.iterations * budget / seconds)))
        segments = simulate(prepared.schedule(gaussians, options, count), detail)
        seconds = budget
    memory = predicted_memory(device, prepared, gaussians.rows, count, segments, trials)
    waits = len({segment.level for segment in segments}) > 1 or not memory.resident
    return Forecast(
        options.iterations, largest(segments), memory, seconds, ends, _photos(device, views, memory.resident, waits)
    )


def _dense_count(prepared: PreparedScene) -> int:
    """About how many dense points will be found: as many as are wanted, or as photos that overlap
    much show places."""
    facts = prepared.decisions.facts
    searched = sum(view.camera.width * view.camera.height for view in with_side(prepared.train_views, SMALL_SIDE))
    return (
        facts.count if math.isnan(facts.shown_in) else min(facts.count, int(DENSE_A_PIXEL * searched / facts.shown_in))
    )


def _photos(device: Device, views: Sequence[View], resident: bool, waits: bool) -> str:
    size = 3 * sum(v.camera.width * v.camera.height for v in views) / MIB
    place = "it" if size * MIB <= photo_store.IN_MEMORY_BYTES else "a file beside the run"
    allowed = photo_store.DEVICE_SHARE * device.memory_limit / MIB
    return (
        f"{'resident' if resident else 'streamed'}: {size:,.0f} MiB at full size, "
        f"{allowed:,.0f} may stay on the device; reading takes up to "
        f"{photo_store.reading_bytes(views) / MIB:,.0f} of the host's memory"
        + f", and photos that wait up to {size:,.0f} more in {place}"
        * waits
    )


def take_trials(
    device: Device, prepared: PreparedScene, gaussians: int, segments: Sequence[Segment], progress: SilentProgress
) -> NDArray[np.float64]:
    """Take steps at the sizes of `tried_sizes` for an initial number of gaussians.

    Returns a row for each: the mean pixels of an image, gaussians, seconds of a step, and bytes of
    device memory beside the model and the photos."""
    regularises = any(segment.regularises for segment in segments)
    trials = []
    for level, count in tried_sizes(prepared.train_views, gaussians, segments, MOST_GAUSSIANS.of(device)):
        progress.phase(f"planning: timing steps at {size_at(level)}, {count:,} gaussians")
        trials.append(_take_trial(device, prepared, level, count, regularises))
    return np.array(trials)


def tried_sizes(views: Sequence[View], count: int, segments: Sequence[Segment], most: int) -> list[tuple[float, int]]:
    """The (level, gaussians) of trial steps.

    These are the first and the last level of the run, each with `count` gaussians and with more, at
    `most`. Two smaller sizes replace images of more than MOST_PIXELS; they show the growth with
    pixels.
    """
    few = min(count, most // MOST_GROWTH)
    many = min(max(segments[-1].gaussians, 2 * few), MOST_GROWTH * few, most)
    first, last = segments[0].level, segments[-1].level
    most_first = max(segment.gaussians for segment in segments if segment.level == first)
    smaller = math.sqrt(pixels(views, 1.0) / MOST_PIXELS)
    if smaller > last:
        first, last = max(first, 2 * smaller), smaller
    return sorted({(first, few), (first, min(many, most_first)), (last, few), (last, many)}, reverse=True)


def _take_trial(
    device: Device, prepared: PreparedScene, level: float, count: int, regularises: bool
) -> tuple[float, int, float, int]:
    views = at_level(prepared.train_views, level)
    renderer = Renderer(device, 0, prepared.near, prepared.options.antialiased)
    chosen = spread_out(len(views), TIMED_VIEWS)
    gaussians = sized(
        sampled(prepared.scene, count, prepared.options.sh_degree), renderer, [views[index].camera for index in chosen]
    )
    rows = {name: device.upload(values) for name, values in gaussians.rows.items()}
    fullest = max(
        spread_out(len(views), COUNTED_VIEWS),
        key=lambda index: len(renderer.visible(rows, renderer.pack(views[index].camera))),
    )
    device.trim()
    before = device.memory_bytes
    photos = SizedPhotos(device, prepared.train_views, level)
    trial = TrialSteps(Session(prepared, device, gaussians, photos=photos))
    # the fullest first, so that frames have room for all
    steps = [trial.prepare(index, regularises) for index in (fullest, *chosen)]
    for step in steps:  # compile kernels and fill the pool
        step()
    trial.finish()
    nbytes = device.memory_bytes - before - photos.nbytes - sum(_model_bytes(device, prepared, gaussians.rows, count))
    turns, each = itertools.cycle(steps[1:]), []
    for _ in range(REPEATS):
        begin, taken = time.perf_counter(), 0
        while time.perf_counter() - begin < TIMED_SECONDS:
            next(turns)()
            taken += 1
        trial.finish()
        each.append((time.perf_counter() - begin) / taken)
    return pixels(prepared.train_views, level), count, float(np.median(each)), max(1, nbytes)


def fitted(image: NDArray[np.float64], count: NDArray[np.float64], cost: NDArray[np.float64]) -> NDArray[np.float64]:
    """Fit (a, b, c) >= 0 to costs [N] at pixels and gaussians [N], by relative errors.

    Images of a single size determine only a + b * pixels.
    """
    columns = np.stack([np.ones_like(image), image / image.max(), count / count.max()], axis=1)
    solution: NDArray[np.float64] = scipy.optimize.nnls(columns / cost[:, None], np.ones_like(cost))[0]
    solution /= np.array([1, image.max(), count.max()])
    return solution


def predicted_seconds(trials: NDArray[np.float64], views: Sequence[View], segments: Sequence[Segment]) -> float:
    """Seconds of a run without evaluations, files and compilation, from steps that were timed."""
    cost = fitted(*trials.T[:3])
    return float(sum(s.steps * np.dot(cost, (1, pixels(views, s.level), s.gaussians)) for s in segments))


def pixels(views: Sequence[View], level: float) -> float:
    """Mean number of pixels of an image at a level."""
    return float(np.mean([v.camera.width * v.camera.height for v in at_level(views, level)]))


def photo_detail(views: Sequence[View], level: float) -> float:
    """The detail that photos at a level would lose at half the size, on which growth depends.

    It is the mean difference, in 0..1, between a photo and the means of its blocks of 2 x 2 pixels,
    for some evenly spaced views.
    """
    lost = []
    for photo in decoded(at_level(views[:: -(-len(views) // DETAIL_VIEWS)], level)):
        height, width = (size // 2 for size in photo.shape[1:])
        even = photo[:3, : 2 * height, : 2 * width] / np.float32(255)
        blocks = even.reshape(3, height, 2, width, 2)
        lost.append(np.abs(blocks - blocks.mean(axis=(2, 4), keepdims=True)).mean())
    return float(np.mean(lost))


def predicted_memory(
    device: Device,
    prepared: PreparedScene,
    names: Iterable[str],
    count: int,
    segments: Sequence[Segment],
    trials: NDArray[np.float64],
) -> Memory:
    """Predict the device memory of a training; DeviceError if an array would be too large.

    Parameters
    ----------
    device, prepared : of the training.
    names, count : the fields and the number of the initial gaussians.
    segments : the simulated run.
    trials : see `take_trials`.
    """
    cost = fitted(*trials.T[[0, 1, 3]])
    photos = {
        level: photo_bytes(device, prepared.train_views, level) for level in {segment.level for segment in segments}
    }
    total, steps = 0, 0
    names = list(names)
    model = _model_bytes(device, prepared, names, count)
    for segment in segments:
        nbytes, _ = photos[segment.level]
        grown = _model_bytes(device, prepared, names, segment.gaussians)
        if grown != model:  # each array is replaced in turn
            total = max(
                total, nbytes + max(sum(grown[: place + 1]) + sum(model[place:]) for place in range(len(model)))
            )
        frame = np.dot(cost, (1, pixels(prepared.train_views, segment.level), segment.gaussians))
        model, steps = grown, max(steps, nbytes + int(frame) + sum(grown))
    # an evaluation copies rows and moments that a view sees, the mean of the last steps has sums
    copied = int(_most_seen(prepared) * sum(model))
    learned = Model.arrays([field.name for field in LEARNED], prepared.options.sh_degree, segments[-1].gaussians)
    sums = sum(spec.nbytes(device.real) for spec in learned.values())
    total = max(total, nbytes + int(frame) + sum(model) + copied + (prepared.options.average > 0) * sums)
    total, limit, waits = max(total, steps), device.memory_limit, 0
    if total > limit and is_pageable(prepared.options):
        count = max(segment.gaussians for segment in segments)
        total, steps, waits = (
            limit,
            min(steps, limit),
            sum(spec.nbytes(device.real) for spec in paged_arrays(prepared.options, count)),
        )
    return Memory(
        total,
        steps,
        max(nbytes * resident for nbytes, resident in photos.values()),
        all(resident for _, resident in photos.values()),
        sum(model),
        waits,
    )


def _most_seen(prepared: PreparedScene) -> float:
    """The largest share of the sparse points that one view has in its image, occluded or not."""
    points, views = prepared.scene.points, prepared.test_views or prepared.train_views
    points, shares = points[:: max(1, -(-len(points) // MOST_SAMPLED))], []
    for view in views[:: -(-len(views) // COUNTED_VIEWS)]:
        (x, y), depth = (each.T for each in view.camera.project(points))
        shares.append(((depth > 0) & (x > 0) & (x < view.camera.width) & (y > 0) & (y < view.camera.height)).mean())
    return float(max(shares))


def photo_bytes(device: Device, views: Sequence[View], level: float) -> tuple[int, bool]:
    """Device bytes of the photos at a level, and whether they stay on the device; where they are
    read at each use, those of the largest one."""
    sizes = [photo_store.photo_array(view).nbytes(device.real) for view in at_level(views, level)]
    stay = sum(sizes) <= photo_store.DEVICE_SHARE * device.memory_limit
    return sum(sizes) if stay else max(sizes), stay


def _model_bytes(device: Device, prepared: PreparedScene, names: Iterable[str], count: int) -> list[int]:
    """Bytes of the arrays of rows and moments, in the order in which growth replaces them."""
    options = prepared.options
    rows = Model.arrays(names, options.sh_degree, count)
    moments = ENGINES[options.engine].arrays({field.name: rows[field.name] for field in LEARNED})
    pages = paged_arrays(options, count) if is_pageable(options) else []  # may be of any size
    specs = [spec for fields in (rows, *moments) for spec in fields.values()]
    device.check_size(max(spec.nbytes(device.real) for spec in specs if spec not in pages))
    return [spec.nbytes(device.real) for spec in specs]
