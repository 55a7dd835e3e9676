"""A whole training step: forward, loss, adjoint, Adam, statistics.

All spherical harmonics are active, and every training view is taken once. The median is that of
steps which are waited for one by one. host_ms is the time in which the host enqueues a step when
nothing is waited for, and stream_ms the time in which the device has done it too; launches, waits
and allocations are those of such a step, and device_mib is the memory on the device.

A profile adds device_ms, the sum of the times of the kernels by the device's clock, and each
kernel's mean; a queue with profiling takes longer to enqueue, so take the other times without it.
"""

import itertools
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from clsplat.bench.measure import Bench, in_turn
from clsplat.bench.workloads import city, in_unit, scene_of
from clsplat.estimate.trial_steps import TrialSteps, sampled
from clsplat.gaussians import Gaussians
from clsplat.io.scenes.read import read_scene
from clsplat.options import TrainOptions, resolve
from clsplat.scene import Scene
from clsplat.training.photos import Photos
from clsplat.training.session import Session
from clsplat.training.start.prepare import PreparedScene, prepare

STREAM = 16  # steps that are enqueued without waiting: few enough for any driver's queue


def main(bench: Bench, scene: Path | None = None, downscale: float = 1.0,
         optimizer: str = TrainOptions.optimizer, profile: bool = False) -> None:
    """Run this benchmark.

    Parameters
    ----------
    scene : None: the made city. Of a scene, 0 gaussians are as many as its points.
    downscale, optimizer : as for a training.
    profile : whether each kernel is timed, on a device that is open for it.
    """
    def prepared(scene: Scene) -> PreparedScene:
        return prepare(scene, resolve({}, {
            "downscale": downscale, "max_resolution": 0, "exposure": "off", "engine": "device",
            "sphere": False, "optimizer": optimizer}))

    read = prepared(read_scene(scene)) if scene else None
    for count in bench.gaussians:
        if read:
            made, gaussians = read, sampled(read.scene, count or len(read.scene.points), 3)
        else:
            gaussians, cameras = city(count)
            made = prepared(scene_of(gaussians, cameras))
            gaussians = in_unit(gaussians, made.scene.unit)
        _measure(bench, made, gaussians, profile)


def _measure(bench: Bench, prepared: PreparedScene, gaussians: Gaussians, profile: bool) -> None:
    """Time the steps of a model, and report them."""
    device, views = bench.device, prepared.train_views
    device.trim()
    trial = TrialSteps(Session(prepared, device, gaussians, photos=Photos(device, views)))
    session, turns = trial.session, itertools.cycle(
        [trial.prepare(index) for index in range(len(views))])

    def one() -> None:
        next(turns)()

    times = in_turn([(trial, one)], len(views), warm_up=len(views)).ravel()
    stream = _streamed(trial, one, max(1, len(views) // STREAM))
    device_mib = device.memory_bytes >> 20
    splats = [session.renderer.count_splats(session.model.rows, camera)
              for camera in session.cameras]
    width, height = views[0].camera.width, views[0].camera.height
    size = {"gaussians": session.model.count, "visible": round(np.mean(splats)), "width": width,
            "height": height, **stream, "device_mib": device_mib}
    kernels: dict[str, list[float]] = {}
    if profile:
        with device.profile() as kernels:
            for _ in views:
                one()
        size["device_ms"] = round(sum(map(sum, kernels.values())) / len(views) * 1e3, 4)
    bench.report("step", f"{prepared.scene.name} {prepared.options.optimizer}", times, size)
    for kernel, seconds in sorted(kernels.items(), key=lambda kernel: -sum(kernel[1])):
        if not bench.as_json:
            print(f"  {kernel:20} {sum(seconds) / len(views) * 1e3:8.3f} ms in "
                  f"{len(seconds) / len(views):.2g} launches", flush=True)


def _streamed(trial: TrialSteps, one: Callable[[], object], rounds: int) -> dict[str, float]:
    """Take STREAM steps several times without waiting between them.

    Returns
    -------
    host_ms : of a step, until it was enqueued; the median.
    stream_ms : of a step, until the device had done it; the median.
    launches, waits, allocations : of a step, by the device's counters.
    """
    device, times = trial.session.device, np.empty((rounds, 2))
    before = device.launches, device.waits, device.allocations
    for number in range(rounds):
        start = time.perf_counter()
        for _ in range(STREAM):
            one()
        enqueued = time.perf_counter()
        trial.finish()
        times[number] = enqueued - start, time.perf_counter() - start
    launches, waits, allocations = ((now - first) / (rounds * STREAM) for first, now in zip(
        before, (device.launches, device.waits, device.allocations)))
    host, whole = (round(float(ms), 4) for ms in np.median(times, axis=0) / STREAM * 1e3)
    return {"host_ms": host, "stream_ms": whole, "launches": launches,
            "waits": waits - 1 / STREAM, "allocations": allocations}
