"""What a training would leave out, and what it would take."""

import dataclasses

from clsplat.errors import InputError
from clsplat.estimate.detail import photo_detail
from clsplat.estimate.memory import Memory, predicted_memory
from clsplat.estimate.step_time import predicted_seconds
from clsplat.gaussians import mean_inverse_distance
from clsplat.options import seconds_of
from clsplat.partition.blocks import seen_pixels, trainable
from clsplat.schedule import laid_over, scaled_steps, schedule_of
from clsplat.schedule.course import course, largest
from clsplat.training.begin import initial_gaussians
from clsplat.training.needs import Part, find_needs, subject_of
from clsplat.training.photos import DEVICE_SHARE
from clsplat.training.silent import Silent

MIB = 2**20


@dataclasses.dataclass(frozen=True, eq=False)
class Forecast:
    """steps: of the whole run; gaussians: the most at a time; memory: plan.memory.Memory; seconds:
    of training; ends: [(level, gaussians, seconds a step), ...] at the beginning and at the end of
    the run; streaming: train.needs.Part, whether photos stay on the device."""

    steps: int
    gaussians: int
    memory: Memory
    seconds: float
    ends: list
    streaming: Part


class Planned:
    """A training as it would begin: its Scene, training views, Needs and schedule.

    scene: Scene as read; options: TrainOptions; progress: told what is being done, by
    progress.phase(text). Raises InputError where it could not begin.
    """

    def __init__(self, scene, options, device, progress=None):
        self.device, self.progress = device, progress or Silent()
        self.progress.phase("planning: looking at the photos")
        self.scene = scene.reduced(options.downscale, options.max_resolution)
        self.views, self.held_out = self.scene.split(options.test_every)
        if len(self.views) < 2:
            raise InputError(f"{scene.name}: {len(self.views)} photos to train on; wants two or "
                             "more: add photos, or use a larger --test-every")
        self.needs = find_needs(self.scene, self.views, scaled_steps(options), device)
        self._details = {}  # level -> of the photos

    def forecast(self):
        """The Forecast. Takes some real steps on the device; raises DeviceError where they, or
        those to come, do not fit."""
        options, arguments = self.needs.options, (self.device, self.scene, self.views, self.needs)
        gaussians = initial_gaussians(self.scene, options)
        self.progress.phase("planning: how many gaussians")
        stretches = self._course(options, gaussians)
        seconds, ends = predicted_seconds(*arguments, gaussians, stretches, self.progress)
        if options.time_budget:
            budget = seconds_of(options.time_budget)
            options = laid_over(options, max(1, int(options.iterations * budget / seconds)))
            stretches, seconds = self._course(options, gaussians), budget
        self.progress.phase("planning: memory")
        memory = predicted_memory(*arguments, gaussians, stretches)
        return Forecast(options.iterations, largest(stretches), memory, seconds, ends,
                        self._streaming(memory))

    def _course(self, options, gaussians):
        """Stretches of a run that begins with these Gaussians; of a block's, some never grow."""
        grows = (gaussians.count if self.scene.region is None
                 else int(trainable(self.scene, gaussians.positions, gaussians.log_scales).sum()))
        subject = dataclasses.replace(
            subject_of(self.scene, self.views,
                       inverse_distance=mean_inverse_distance(self.scene.points)),
            count=grows, pixels=seen_pixels(self.scene, self.views))
        schedule = schedule_of(options.schedule)(options, subject)
        unknown = set(schedule.levels) - self._details.keys()
        if unknown:
            self._details |= photo_detail(self.views, sorted(unknown))
        stretches = course(schedule, self._details.get)
        return [dataclasses.replace(stretch, gaussians=stretch.gaussians + gaussians.count - grows)
                for stretch in stretches]

    def _streaming(self, memory):
        size = 3 * sum(v.camera.width * v.camera.height for v in self.views)
        value = "resident" if memory.resident else "streamed"
        allowed = DEVICE_SHARE * self.device.handle.global_mem_size
        return Part(value, f"{value}: {size / MIB:,.0f} MiB at full size, {allowed / MIB:,.0f} may "
                    "stay on the device")
