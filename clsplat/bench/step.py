"""A whole training step: forward, loss, adjoint, Adam, statistics.

The scene is that of --scene, or the made city of the other benchmarks; all spherical harmonics are
active, and every training view is taken once. Of a scene, 0 gaussians are as many as its points.
The median is that of steps which are waited for one by one. host_ms is the time in which the host
enqueues a step when nothing is waited for, and stream_ms the time in which the device has done it
too; launches, waits and allocations are those of such a step.

device_mib is the memory on the device; peak_mib that of this process, so measure it with one count
only. --profile adds device_ms, the sum of the times of the kernels by the device's clock, and each
kernel's mean; a queue with profiling takes longer to enqueue, so take the other times without it.
"""

import itertools
import sys
import time
from argparse import Namespace
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

try:
    import resource
except ImportError:
    resource = None  # type: ignore[assignment]  # a module that Windows does not have

from clsplat.device import Device
from clsplat.estimate.trial_steps import TrialSteps, sampled
from clsplat.gaussians import Gaussians
from clsplat.io.scenes.read import read_scene
from clsplat.options import TrainOptions, resolve
from clsplat.scene import Scene
from clsplat.training.photos import Photos
from clsplat.training.session import Session
from clsplat.training.start.prepare import PreparedScene, prepare

from .measure import Bench
from .timing import milliseconds
from .workloads import city, in_unit, scene_of

CITY = "city"
STREAM = 16  # steps that are enqueued without waiting: few enough for any driver's queue


def main(argv: Sequence[str]) -> None:
    """Run this benchmark with its flags."""
    bench = Bench(argv, __doc__, scene=CITY, downscale=1.0, gaussians="100k",
                  optimizer=TrainOptions.optimizer, profile=False)
    if bench.options.scene == CITY:
        for count in bench.options.gaussians:
            gaussians, cameras = city(count)
            made = prepared_scene(scene_of(gaussians, cameras), bench.options)
            measure(bench, made, Photos(bench.device, made.train_views),
                    in_unit(gaussians, made.scene.unit))
        return
    prepared = prepared_scene(read_scene(bench.options.scene), bench.options)
    photos = Photos(bench.device, prepared.train_views)
    for count in bench.options.gaussians:
        measure(bench, prepared, photos, sampled(
            prepared.scene, count or len(prepared.scene.points), 3))


def prepared_scene(scene: Scene, options: Namespace) -> PreparedScene:
    """A scene for steps whose every part is on and whose moments are on the device."""
    return prepare(scene, resolve({}, {
        "downscale": options.downscale, "max_resolution": 0, "exposure": "off", "engine": "device",
        "sphere": False, "optimizer": options.optimizer}))


def measure(bench: Bench, prepared: PreparedScene, photos: Photos, gaussians: Gaussians) -> None:
    """Time the steps of a model, and report them."""
    device, views = bench.device, prepared.train_views
    device.trim()
    trial = TrialSteps(Session(prepared, device, gaussians, photos=photos))
    session, turns = trial.session, itertools.cycle(
        [trial.prepare(index) for index in range(len(views))])

    def one(turns: Iterator[Callable[[], object]] = turns) -> None:
        next(turns)()

    times = milliseconds(trial, one, len(views), warm_up=len(views))
    stream = streamed(trial, one, max(1, len(views) // STREAM))
    device_mib = device.memory_bytes >> 20
    splats = [session.renderer.count_splats(session.model.rows, camera)
              for camera in session.cameras]
    width, height = views[0].camera.width, views[0].camera.height
    size = {"gaussians": session.model.count, "visible": round(np.mean(splats)), "width": width,
            "height": height, **stream, "peak_mib": peak_mib(), "device_mib": device_mib}
    kernels = profiled(device, one, len(views)) if bench.options.profile else {}
    if kernels:
        size["device_ms"] = round(sum(sum(seconds) for seconds in kernels.values())
                                  / len(views) * 1e3, 4)
    bench.report("step", f"{prepared.scene.name} {bench.options.optimizer}", times, size)
    for kernel, seconds in kernels.items() if not bench.options.json else ():
        print(f"  {kernel:20} {sum(seconds) / len(views) * 1e3:8.3f} ms in "
              f"{len(seconds) / len(views):.2g} launches", flush=True)


def streamed(trial: TrialSteps, one: Callable[[], object], rounds: int) -> dict[str, float]:
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


def profiled(device: Device, one: Callable[[], object], steps: int) -> dict[str, list[float]]:
    """Seconds of each launch by kernel over a number of steps, the longest kernel first."""
    with device.profile() as times:
        for _ in range(steps):
            one()
    return dict(sorted(times.items(), key=lambda kernel: -sum(kernel[1])))


def peak_mib() -> int | None:
    """The most memory that this process has used, in MiB; None where Python does not know it."""
    status = Path("/proc/self/status")
    if status.is_file():  # getrusage also counts the peak of the process that started this one
        values = dict(line.split(":", 1) for line in status.read_text("utf-8").splitlines())
        return int(values["VmHWM"].split()[0]) >> 10
    if resource is None:
        return None
    unit = 1 << 20 if sys.platform == "darwin" else 1 << 10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // unit
