"""The state of a training, built in one place for trainings, estimates and benchmarks.

A session has no files and no clock; of its progress it reports only what is being done now.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from clsplat.densify.scores import SizedCamera
from clsplat.device import Array, Device
from clsplat.evaluation.held_out_responses import Predicted, predicted_responses
from clsplat.gaussians import Gaussians
from clsplat.rendering.pipeline import Renderer
from clsplat.scene import View
from clsplat.schedule.plan import Plan, Schedule, size_at
from clsplat.schedule.steps import laid_over
from clsplat.training.model import Model
from clsplat.training.part import Part, TrainingSample, ViewPass, overriding
from clsplat.training.parts import parts_of
from clsplat.training.parts.exposures import PhotoResponses
from clsplat.training.photos import Photos, epoch_order
from clsplat.training.progress import SilentProgress
from clsplat.training.start.prepare import PreparedScene
from clsplat.training.step import Step
from clsplat.training.units import MOST_PENDING

FEW_PHOTOS = 3  # of steps that may be repeated, where photos do not stay on the device
SCORING_VIEWS = 10  # for a schedule that scores gaussians
AnyPart = TypeVar("AnyPart", bound=Part)


class Session:
    """The state of a training after `iteration` steps.

    The schedule decides level and growth; without one the caller does. The attribute `level` is
    the down-sampling factor of the training images, `cameras` are their packed cameras, and
    `options` may be replaced between steps (`lay_over`).
    """

    def __init__(
        self,
        prepared: PreparedScene,
        device: Device,
        gaussians: Gaussians,
        photos: Photos,
        schedule: Schedule | None = None,
        progress: SilentProgress | None = None,
    ) -> None:
        self.device, self.progress = device, progress or SilentProgress()
        if schedule is not None:
            self.schedule = schedule
        self.prepared, self.scene, self.decisions = prepared, prepared.scene, prepared.decisions
        self.train_views, self.test_views = prepared.train_views, prepared.test_views
        self.options = options = prepared.options
        self.renderer = Renderer(device, options.sh_degree, prepared.near, options.antialiased, options.background)
        self.photos = photos
        self.iteration, self.level = 0, 0.0
        self.parts = parts_of(prepared)
        for part in self.parts:
            part.begin(self)
        model = Model(device, gaussians, options.engine, photos.folder)
        self.step = Step(self.renderer, model, self.scene.extent, prepared.pixel, options, self.parts)
        self._epochs: dict[int, NDArray[np.int64]] = {}  # the latest ones: the order of their views
        self.use_level(self.photos.level)

    @property
    def model(self) -> Model:
        """The gaussians, after all steps that were taken; waits for these."""
        return self.step.model

    def part(self, kind: type[AnyPart]) -> AnyPart | None:
        """The part of a kind; None: there is none."""
        return next((part for part in self.parts if isinstance(part, kind)), None)

    def use_level(self, level: float) -> bool:
        """Train on images `level` times smaller from now on; returns whether that is a change."""
        if level == self.level:
            return False
        self.level = level
        self.progress.phase(f"reading photos at {size_at(level)}")
        self.photos.use(level)
        for part in self.parts:
            part.begin_level(self)
        self.cameras = [self.renderer.pack(view.camera) for view in self.photos.views]
        self.step.begin_level()
        # pending steps hold their photos, which elsewhere come and go
        stays = self.photos.resident and all(part.resident for part in self.parts)
        self.step.units.most_pending = MOST_PENDING if stays else 1 + FEW_PHOTOS
        return True

    def sample(self, view: int, number: int) -> TrainingSample:
        """The sample of a view, with the number of views that have been trained on then."""
        return TrainingSample(view, self.cameras[view], self.photos[view], self.train_views[view].may_have_mask, number)

    def samples(self, plan: Plan) -> Iterator[TrainingSample]:
        """The samples of the next step, with this plan; begins to read the photos that follow each.

        Epochs are shuffled and contain each view once, or in blocks of a city more or less often
        (`Part.visits`); a step takes the next options.batch views.
        """
        taken = self.iteration * self.options.batch
        for number in range(taken + 1, taken + 1 + self.options.batch):
            sample = self.sample(self._view_of(number), number)
            if not self.photos.resident:
                following = self._view_of(number + 1)
                self.photos.expect(following)
                for part in self.parts:
                    for other in part.read_ahead(plan, following, number + 1):
                        self.photos.expect(other)
            yield sample

    def upcoming(self, number: int) -> tuple[int, Array]:
        """The number-th view (from 1) that is trained on, and its packed camera."""
        view = self._view_of(number)
        return view, self.cameras[view]

    def _view_of(self, number: int) -> int:
        """Index of the number-th view (from 1) that is trained on."""
        epoch, place = divmod(number - 1, len(self.train_views))
        if epoch not in self._epochs:
            visits = np.ones(len(self.train_views))
            for part in self.parts:
                visits = visits * part.visits(self.train_views)
            self._epochs = {
                **{known: order for known, order in self._epochs.items() if abs(known - epoch) == 1},
                epoch: epoch_order(self.options.seed, epoch, visits),
            }
        return int(self._epochs[epoch][place])

    def predicted(self) -> Predicted | None:
        """The responses of all views, for an evaluation; None without exposures."""
        self.step.settle()
        responses = self.part(PhotoResponses)
        return predicted_responses(self.scene.views, responses.responses(self) if responses else None)

    def corrected(self, views: Iterable[View]) -> tuple[View, ...]:
        """The training views, at any size, with what the parts learned of their cameras."""
        self.step.settle()
        found: Sequence[View] = tuple(views)
        for part in self.parts:
            found = part.corrected(found)
        return tuple(found)

    def recentre(self) -> None:
        """Let the parts recentre what they have learned; called once an epoch. Steps are settled
        then in any case: a view that lacks room is noticed early, and fewer steps are repeated."""
        self.step.settle()
        for part in overriding(self.parts, "recentre"):
            part.recentre()

    def finish(self) -> None:
        """Let the parts end the training, after its last step."""
        for part in self.parts:
            part.finish(self)

    def scoring_views(self) -> list[ViewPass]:
        """Random training views, others at each step."""
        rng = np.random.default_rng([self.options.seed, 3, self.iteration])
        count = len(self.train_views)
        chosen = rng.choice(count, min(SCORING_VIEWS, count), replace=False)
        return list(self.shown(chosen.tolist()))

    def shown(self, views: Iterable[int]) -> Iterator[ViewPass]:
        """Training views at this level as a step is about to render them, with what was learned of
        their cameras and responses."""
        parts = overriding(self.parts, "respond")
        now = self.step.now(max(1, self.iteration), self.schedule.plan(max(1, self.iteration)))
        cameras = [view.camera for view in self.corrected(self.photos.views)]
        for view in views:
            sample = replace(self.sample(view, 1), camera=self.renderer.pack(cameras[view]))
            work = self.step.pass_of(sample)
            for part in parts:
                if (inputs := part.inputs(now, sample)) is not None:
                    part.respond(work, inputs)
            yield work

    def sized_cameras(self) -> Iterator[SizedCamera]:
        """The training views at this level, with what was learned of their cameras."""
        for view in self.corrected(self.photos.views):
            camera = view.camera
            yield self.renderer.pack(camera), camera.width, camera.height

    def lay_over(self, iterations: int) -> None:
        """Fit the whole schedule to a number of steps, or to `Decisions.most_steps`."""
        self.options = laid_over(self.decisions.options, min(iterations, self.decisions.most_steps))
        self.schedule.options = self.step.options = self.options
