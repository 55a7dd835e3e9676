"""Plans a training: its decisions, and a forecast of its memory and time."""

import dataclasses
from collections.abc import Iterable, Sequence

from clsplat.device import Device
from clsplat.estimate.cost import (
    Memory,
    TimedStep,
    predicted_memory,
    predicted_seconds,
    seconds_of_a_step,
    take_trials,
)
from clsplat.estimate.detail import photo_detail
from clsplat.estimate.trial_steps import sampled
from clsplat.gaussians import Gaussians
from clsplat.options import ScheduledOptions, TrainOptions, seconds_of
from clsplat.scene import Scene
from clsplat.schedule import laid_over
from clsplat.schedule.simulate import Segment, largest, simulate
from clsplat.training.part import Decision, Part
from clsplat.training.photos import DEVICE_SHARE, reading_bytes
from clsplat.training.progress import SilentProgress
from clsplat.training.start.initialise import initial_gaussians, start_seconds
from clsplat.training.start.prepare import prepare

MIB = 2**20


@dataclasses.dataclass(frozen=True, eq=False)
class Forecast:
    """The predicted course of a training.

    Attributes
    ----------
    steps : length of the run.
    gaussians : largest number of gaussians.
    memory : device memory.
    seconds : time of training.
    ends : (level, gaussians, seconds per step) at the beginning and at the end of the run.
    streaming : whether photos stay on the device.
    measured : [(pixels, gaussians, seconds), ...] of the steps on which the times rest.
    """

    steps: int
    gaussians: int
    memory: Memory
    seconds: float
    ends: list[tuple[float, int, float]]
    streaming: Decision
    measured: list[TimedStep]


class Planned:
    """A training that is prepared but not begun; InputError where it cannot be.

    Parameters
    ----------
    scene, options, device, parts : see `training.prepare.prepare`.
    progress : receives what is being done.

    Attributes
    ----------
    prepared : the scene, ready for training.
    """

    def __init__(self, scene: Scene, options: TrainOptions, device: Device,
                 progress: SilentProgress | None = None, parts: Iterable[Part] = ()) -> None:
        self.device, self.progress = device, progress or SilentProgress()
        self.progress.phase("planning: inspecting the photos")
        self.prepared = prepare(scene, options, device, parts)
        self._details: dict[float, float] = {}  # level -> `photo_detail`

    def forecast(self, known: Sequence[TimedStep] = ()) -> Forecast:
        """Forecast the training; this takes some real steps on the device, which are not timed if
        `known` has steps, of another device or of an earlier training.

        Raises DeviceError where these steps, or those to come, do not fit the device.
        """
        options, prepared = self.prepared.options, self.prepared
        scene, count = prepared.scene, prepared.decisions.facts.count
        gaussians = (sampled(scene, count, options.sh_degree) if options.init == "dense" else
                     initial_gaussians(scene, options))
        self.progress.phase("planning: how many gaussians")
        segments = self._segments(options, gaussians)
        trials = take_trials(self.device, prepared, gaussians.count, segments, not known,
                             self.progress)
        measured = list(known) or [(t.pixels, float(t.gaussians), t.seconds) for t in trials]
        views = prepared.train_views
        seconds = predicted_seconds(measured, views, segments)
        ends = [(segment.level, segment.gaussians, seconds_of_a_step(measured, views, segment))
                for segment in (segments[0], segments[-1])]
        if not known:  # of this device
            self.progress.phase("planning: timing the search for dense points")
            seconds += start_seconds(self.device, prepared)
        if options.time_budget:
            budget = seconds_of(options.time_budget)
            options = laid_over(options, max(1, int(options.iterations * budget / seconds)))
            segments, seconds = self._segments(options, gaussians), budget
        memory = predicted_memory(self.device, prepared, gaussians, segments, trials)
        return Forecast(options.iterations, largest(segments), memory, seconds, ends,
                        self._streaming(memory, len({segment.level for segment in segments})),
                        measured)

    def _segments(self, options: ScheduledOptions, gaussians: Gaussians) -> list[Segment]:
        """The simulated run, including the gaussians of a block that are frozen."""
        schedule = self.prepared.schedule(gaussians, options)
        unknown = set(schedule.levels) - self._details.keys()
        if unknown:
            self._details |= photo_detail(self.prepared.train_views, sorted(unknown))
        frozen = gaussians.count - schedule.facts.count
        return [dataclasses.replace(segment, gaussians=segment.gaussians + frozen)
                for segment in simulate(schedule, self._details.__getitem__)]

    def _streaming(self, memory: Memory, levels: int) -> Decision:
        views = self.prepared.train_views
        size = 3 * sum(v.camera.width * v.camera.height for v in views)
        value = "resident" if memory.resident else "streamed"
        allowed = DEVICE_SHARE * self.device.handle.global_mem_size
        waits = levels > 1 or not memory.resident
        file = f", and a file beside the run up to {size / MIB:,.0f}" if waits else ""
        return Decision(value, f"{value}: {size / MIB:,.0f} MiB at full size, "
                        f"{allowed / MIB:,.0f} may stay on the device; reading takes up to "
                        f"{reading_bytes(views) / MIB:,.0f} of the host's memory{file}")
