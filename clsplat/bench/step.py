"""A whole training step: forward, loss, adjoint, Adam, statistics."""

import itertools
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.device import Device
from clsplat.estimate.trial_steps import TrialSteps, sampled
from clsplat.io.scenes.read import read_scene
from clsplat.options import resolve
from clsplat.training.photos import Photos
from clsplat.training.session import Session
from clsplat.training.start.prepare import PreparedScene, prepare

STREAM = 16  # steps that are enqueued without waiting: few enough for any driver's queue


def prepared_for(scene: Path, **options: Any) -> PreparedScene:
    """A scene, read for plain steps: without the parts that some trainings have."""
    return prepare(
        read_scene(scene),
        resolve({}, {"max_resolution": 0, "exposure": "off", "engine": "device", "sphere": False, **options}),
    )


def time_steps(device: Device, scene: Path, count: int, profile: bool, **options: Any) -> dict[str, Any]:
    """Take every training view of a scene once, with all spherical harmonics, by turns.

    Parameters
    ----------
    device : open for profiling, if kernels are to be timed by its clock.
    count : gaussians, drawn from the points; 0: as many as these.
    profile : whether kernels are timed. A queue with profiling takes longer to enqueue.
    options : of a training, such as downscale.

    Returns
    -------
    median_ms, quartiles_ms (lower, upper) and repeats of steps that are waited for one by one;
    host_ms, until a step is enqueued where nothing is waited for, and stream_ms, until the device
    has done it; launches, waits and allocations of such a step; device_mib; and kernels_ms by
    function, of a profile.
    """
    prepared = prepared_for(scene, **options)
    views = prepared.train_views
    gaussians = sampled(prepared.scene, count or len(prepared.scene.points), 3)
    device.trim()
    trial = TrialSteps(Session(prepared, device, gaussians, photos=Photos(device, views)))
    session, steps = trial.session, [trial.prepare(index) for index in range(len(views))]
    times = []
    for step in (*steps, *steps):  # the first round compiles kernels and fills the pool
        start = time.perf_counter()
        step()
        trial.finish()
        times.append((time.perf_counter() - start) * 1e3)
    low, median, high = np.percentile(times[len(steps) :], (25, 50, 75)).round(4).tolist()
    streamed = _streamed(trial, steps)
    splats = [len(session.renderer.visible(session.model.rows, camera)) for camera in session.cameras]
    width, height = views[0].camera.width, views[0].camera.height
    record = {
        "scene": prepared.scene.name,
        "device": device.name,
        "form": device.form,
        "gaussians": session.model.count,
        "visible": round(np.mean(splats)),
        "width": width,
        "height": height,
        "median_ms": median,
        "quartiles_ms": [low, high],
        "repeats": len(steps),
        **streamed,
        "device_mib": device.memory_bytes >> 20,
    }
    if profile:
        with device.profile() as kernels:
            for step in steps:
                step()
        record["kernels_ms"] = {
            name: round(sum(seconds) / len(views) * 1e3, 4)
            for name, seconds in sorted(kernels.items(), key=lambda kernel: -sum(kernel[1]))
        }
    return record


def table(record: dict[str, Any]) -> str:
    """A line for each field of what `time_steps` returns."""
    lines = [f"{name:14} {value}" for name, value in record.items() if name != "kernels_ms"]
    return "\n".join([*lines, *(f"  {kernel:20} {ms:8.3f} ms" for kernel, ms in record.get("kernels_ms", {}).items())])


def _streamed(trial: TrialSteps, steps: Sequence[Callable[[], object]]) -> dict[str, float]:
    """host_ms, stream_ms (medians), launches, waits and allocations of a step, where STREAM steps
    are taken several times without waiting between them."""
    rounds, turns = max(1, len(steps) // STREAM), itertools.cycle(steps)
    device, times = trial.session.device, np.empty((rounds, 2))
    before = device.launches, device.waits, device.allocations
    for number in range(rounds):
        start = time.perf_counter()
        for _ in range(STREAM):
            next(turns)()
        enqueued = time.perf_counter()
        trial.finish()
        times[number] = enqueued - start, time.perf_counter() - start
    launches, waits, allocations = (
        (now - first) / (rounds * STREAM)
        for first, now in zip(before, (device.launches, device.waits, device.allocations))
    )
    host, whole = (round(float(ms), 4) for ms in np.median(times, axis=0) / STREAM * 1e3)
    return {
        "host_ms": host,
        "stream_ms": whole,
        "launches": launches,
        "waits": waits - 1 / STREAM,
        "allocations": allocations,
    }
