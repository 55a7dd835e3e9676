"""What a training would leave out, and what it would take."""

import dataclasses

from clsplat.device import Device
from clsplat.estimate.detail import photo_detail
from clsplat.estimate.memory import Memory, predicted_memory
from clsplat.estimate.step_time import predicted_seconds
from clsplat.gaussians import Gaussians
from clsplat.options import TrainOptions, seconds_of
from clsplat.scene import Scene
from clsplat.schedule import laid_over
from clsplat.schedule.simulate import Segment, largest, simulate
from clsplat.training.decisions import Decision
from clsplat.training.initialise import initial_gaussians
from clsplat.training.photos import DEVICE_SHARE
from clsplat.training.progress import SilentProgress
from clsplat.training.session import prepare

MIB = 2**20


@dataclasses.dataclass(frozen=True, eq=False)
class Forecast:
    """What a training is expected to take.

    Attributes
    ----------
    steps : of the whole run.
    gaussians : the most at a time.
    memory : of the device.
    seconds : of training.
    ends : [(level, gaussians, seconds a step), ...] at the beginning and at the end of the run.
    streaming : whether photos stay on the device.
    """

    steps: int
    gaussians: int
    memory: Memory
    seconds: float
    ends: list[tuple[float, int, float]]
    streaming: Decision


class Planned:
    """A training as it would begin; InputError where it could not.

    Parameters
    ----------
    scene : as it was read.
    options : as they were given.
    device : of the training.
    progress : told what is being done.

    Attributes
    ----------
    prepared : the scene as it would be trained on.
    """

    def __init__(self, scene: Scene, options: TrainOptions, device: Device,
                 progress: SilentProgress | None = None) -> None:
        self.device, self.progress = device, progress or SilentProgress()
        self.progress.phase("planning: looking at the photos")
        self.prepared = prepare(scene, options, device)
        self._details: dict[float, float] = {}  # level -> of the photos

    def forecast(self) -> Forecast:
        """The Forecast. Takes some real steps on the device; raises DeviceError where they, or
        those to come, do not fit."""
        options, prepared = self.prepared.options, self.prepared
        gaussians = initial_gaussians(prepared.scene, options)
        self.progress.phase("planning: how many gaussians")
        segments = self._segments(options, gaussians)
        seconds, ends = predicted_seconds(self.device, prepared, gaussians, segments,
                                          self.progress)
        if options.time_budget:
            budget = seconds_of(options.time_budget)
            options = laid_over(options, max(1, int(options.iterations * budget / seconds)))
            segments, seconds = self._segments(options, gaussians), budget
        self.progress.phase("planning: memory")
        memory = predicted_memory(self.device, prepared, gaussians, segments)
        return Forecast(options.iterations, largest(segments), memory, seconds, ends,
                        self._streaming(memory))

    def _segments(self, options: TrainOptions, gaussians: Gaussians) -> list[Segment]:
        """Those of a run that begins with these gaussians; of a block's, some never grow."""
        schedule = self.prepared.schedule(gaussians, options)
        unknown = set(schedule.levels) - self._details.keys()
        if unknown:
            self._details |= photo_detail(self.prepared.train_views, sorted(unknown))
        frozen = gaussians.count - schedule.facts.count
        return [dataclasses.replace(segment, gaussians=segment.gaussians + frozen)
                for segment in simulate(schedule, self._details.get)]

    def _streaming(self, memory):
        size = 3 * sum(v.camera.width * v.camera.height for v in self.prepared.train_views)
        value = "resident" if memory.resident else "streamed"
        allowed = DEVICE_SHARE * self.device.handle.global_mem_size
        return Decision(value, f"{value}: {size / MIB:,.0f} MiB at full size, "
                        f"{allowed / MIB:,.0f} may stay on the device")
