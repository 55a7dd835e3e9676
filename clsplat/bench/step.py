"""A whole training step on a real scene: forward, loss, adjoint, Adam, statistics.

Default: caliterra at full resolution, its initial gaussians and 100 000, all harmonics active,
every training view once. Peak memory is that of this process, so ask for one count a process to
read it.
--profile adds each kernel's mean time a step, by the device's clock.
"""

import itertools
import sys

try:
    import resource
except ImportError:  # Windows
    resource = None

from clsplat.estimate.trial_steps import TrialSteps, sampled
from clsplat.io.scenes import read_scene
from clsplat.options import TrainOptions, resolve
from clsplat.training.photos import Photos
from clsplat.training.session import Session, prepare

from .measure import Bench
from .timing import milliseconds


def main(argv):
    bench = Bench(argv, __doc__, scene="../shared/data/caliterra", downscale=1.0,
                  gaussians="0,100k", optimizer=TrainOptions.optimizer, profile=False)
    device, options = bench.device, bench.options
    prepared = prepare(read_scene(options.scene), resolve({}, {
        "downscale": options.downscale, "max_resolution": 0, "exposure": "off", "engine": "device",
        "sphere": False, "optimizer": options.optimizer}))
    scene, views = prepared.scene, prepared.train_views
    photos = Photos(device, views)
    for count in options.gaussians:
        trial = TrialSteps(Session(prepared, device, sampled(scene, count or len(scene.points), 3),
                                   photos=photos))
        model, turns = trial.session.model, itertools.cycle(
            [trial.prepare(index) for index in range(len(views))])

        def one(turns=turns):
            next(turns)()

        times = milliseconds(device, one, len(views), warm_up=len(views))
        width, height = views[0].camera.width, views[0].camera.height
        bench.report("step", f"{scene.name} {options.optimizer}", times,
                     {"gaussians": model.count, "width": width, "height": height,
                      "peak_mib": peak_mib(), "device_mib": device.memory_bytes >> 20})
        if options.profile:
            with device.profile() as times_by_kernel:
                for _ in views:
                    one()
            for kernel, seconds in sorted(times_by_kernel.items(), key=lambda kv: -sum(kv[1])):
                mean = sum(seconds) / len(views) * 1e3
                print(f"  {kernel:20} {mean:8.3f} ms in {len(seconds) // len(views)} launches")


def peak_mib():
    """The most memory that this process has held, in MiB; None where Python cannot tell."""
    if resource is None:
        return None
    unit = 1 << 20 if sys.platform == "darwin" else 1 << 10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // unit
