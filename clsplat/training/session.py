"""What a training consists of, built in one place for trainings, estimates and benchmarks.

A Session knows no files, no clock, and of progress only what is being done now.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.device import Array, Device
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians, mean_inverse_distance
from clsplat.loss.exposure import Exposures
from clsplat.loss.term import SourceView, TrainingSample
from clsplat.options import TrainOptions
from clsplat.partition.blocks import seen_pixels, trainable
from clsplat.rendering.pipeline import Renderer
from clsplat.scene import Scene, View
from clsplat.schedule import Plan, SceneFacts, Schedule, laid_over, scaled_steps, schedule_of
from clsplat.training.decisions import Decisions, find_decisions, smallest_size
from clsplat.training.initialise import initial_exposures, initial_gaussians
from clsplat.training.model import Model
from clsplat.training.photos import Photos, decoded
from clsplat.training.progress import SilentProgress
from clsplat.training.source_views import SourceViews
from clsplat.training.step import Step

SCORING_VIEWS = 10  # by which a schedule may score gaussians before it grows


@dataclass(frozen=True, eq=False)
class PreparedScene:
    """A scene as it is trained on.

    Attributes
    ----------
    scene : its photos at the size of training, its unit the scene's extent: steps are the same
        whatever unit the coordinates have.
    train_views, test_views : the views trained on, and those held out.
    decisions : what the scene decides of the options.
    """

    scene: Scene
    train_views: tuple[View, ...]
    test_views: tuple[View, ...]
    decisions: Decisions

    @property
    def options(self) -> TrainOptions:
        """The options, in which nothing is left to decide."""
        return self.decisions.options

    @property
    def near(self) -> float:
        """The near plane, in units of the scene."""
        return self.scene.near(self.options.near)

    @property
    def trains(self) -> Callable[..., NDArray[np.bool_]] | None:
        """Which gaussians a block of a city trains (`step.Step`); None: all."""
        return functools.partial(trainable, self.scene) if self.scene.region else None

    def schedule(self, gaussians: Gaussians, options: TrainOptions | None = None) -> Schedule:
        """A schedule that begins with `gaussians`; options: other than those decided."""
        trains, views, options = self.trains, self.train_views, options or self.options
        count = (int(trains(gaussians.positions, gaussians.log_scales).sum()) if trains
                 else gaussians.count)
        return schedule_of(options.schedule)(options, SceneFacts(
            smallest_size(views), count, mean_inverse_distance(self.scene.points) / self.scene.unit,
            lambda: decoded(views), seen_pixels(self.scene, views)))


def prepare(scene: Scene, options: TrainOptions, device: Device | None = None) -> PreparedScene:
    """Prepare a scene for training; InputError where it cannot be trained on.

    Parameters
    ----------
    scene : as it was read.
    options : as they were given.
    device : that of the training.
    """
    scene = scene.reduced(options.downscale, options.max_resolution).normalised()
    if len(scene.views) < 2:
        raise InputError(f"{scene.name}: has a single photo; depth needs at least two from "
                         "different places, and 20 or more make a good model")
    train_views, test_views = scene.split(options.test_every)
    if not train_views:
        raise InputError(f"{scene.name}: --test-every {options.test_every} holds out every "
                         "view; use a larger number, or none")
    return PreparedScene(scene, train_views, test_views,
                         find_decisions(scene, train_views, scaled_steps(options), device))


class Session:
    """A training as it stands after `iteration` steps: what steps change, and what they need.

    Parameters
    ----------
    prepared : the scene.
    device : of the training.
    gaussians : to begin with.
    schedule : decides level and growth; None: who takes the steps does.
    photos : of the training views; None: all those of the schedule's levels.
    progress : told what is being done.

    Attributes
    ----------
    step : takes steps; has the model, the exposures and what is kept of gradients.
    source_views : None where no loss term compares with another view.
    level : down-sampling factor of the images that are trained on.
    cameras : packed, of the training views at that level.
    options : may be replaced between steps (`lay_over`).
    """

    def __init__(self, prepared: PreparedScene, device: Device, gaussians: Gaussians,
                 schedule: Schedule | None = None, photos: Photos | None = None,
                 progress: SilentProgress | None = None) -> None:
        self.device, self.schedule, self.progress = device, schedule, progress or SilentProgress()
        self.scene, self.decisions = prepared.scene, prepared.decisions
        self.train_views, self.test_views = prepared.train_views, prepared.test_views
        self.options = options = prepared.options
        self.renderer = Renderer(device, options.sh_degree, prepared.near, options.antialiased,
                                 options.background)
        model = Model(device, gaussians, options.engine, options.optimizer == "dense")
        exposures = None
        if options.exposure == "on":
            # blocks that learned their own would not agree
            given = initial_exposures(self.scene, self.train_views)
            exposures = Exposures(device, len(self.train_views), initial=given,
                                  learns=given is None)
        self.step = Step(self.renderer, model, self.scene.extent, options, exposures,
                         prepared.trains)
        neighbours = self.decisions.neighbours
        self.source_views = neighbours and SourceViews(device, neighbours, exposures, options.seed)
        self.iteration, self.level = 0, 0.0
        self.photos = photos or Photos(device, self.train_views, schedule.levels)
        self.use_level(self.photos.level)

    @classmethod
    def build(cls, scene: Scene, options: TrainOptions, device: Device,
              progress: SilentProgress | None = None,
              gaussians: Gaussians | None = None) -> Session:
        """Build what a training needs, and read its photos, those held out too.

        Parameters
        ----------
        scene : as it was read.
        options : as they were given.
        device : of the training.
        progress : told what is being done.
        gaussians : where a resumed run goes on; None: begin as the options say.

        Raises
        ------
        InputError : for a scene, an option or a photo that cannot be trained with.
        """
        progress = progress or SilentProgress()
        progress.phase("planning")
        prepared = prepare(scene, options, device)
        gaussians = gaussians or initial_gaussians(prepared.scene, prepared.options)
        schedule = prepared.schedule(gaussians)
        progress.phase("reading photos")
        for _ in decoded(prepared.test_views):
            pass  # a damaged one would end the run at its evaluation
        return cls(prepared, device, gaussians, schedule, progress=progress)

    @property
    def model(self) -> Model:
        """The gaussians."""
        return self.step.model

    def use_level(self, level: float) -> bool:
        """Train on images `level` times smaller from now on; whether that changed anything."""
        if level == self.level:
            return False
        self.level = level
        self.progress.phase(f"reading photos of level {level:g}")
        self.photos.use(level)
        cameras = [view.camera for view in self.photos.views]
        if self.source_views:
            self.source_views.use(cameras)
        self.cameras = [self.renderer.pack(camera) for camera in cameras]
        self.step.statistics.clear(self.model.count)
        return True

    def sample(self, view: int, number: int, plan: Plan) -> TrainingSample:
        """What a step learns from a view, which is the number-th that is trained on."""
        drawn, source = self._source(view, number, plan), None
        if drawn:
            row, other = drawn
            source = SourceView(self.photos[other], self.source_views.geometries,
                                self.source_views.colours, row)
        return TrainingSample(view, self.cameras[view], self.photos[view], source)

    def expect(self, view: int, number: int, plan: Plan) -> None:
        """Begin to read what `sample` will need."""
        if self.photos.resident:
            return
        self.photos.expect(view)
        drawn = self._source(view, number, plan)
        if drawn:
            self.photos.expect(drawn[1])

    def _source(self, view, number, plan):
        wanted = any(term.needs_source for term in self.step.terms_in(plan))
        return self.source_views.drawn(number, view) if wanted and self.source_views else None

    def recentre(self) -> None:
        """Let exposures have the mean that they had at the start: once an epoch."""
        if self.step.exposures:
            self.step.exposures.recentre()
            if self.source_views:
                self.source_views.compare_colours()

    def scoring_views(self) -> list[tuple[Array, Array]]:
        """[(packed camera, photo), ...] of some training views, others at each step."""
        rng = np.random.default_rng([self.options.seed, 3, self.iteration])
        count = len(self.train_views)
        chosen = rng.choice(count, min(SCORING_VIEWS, count), replace=False)
        return [(self.cameras[i], self.photos[i]) for i in chosen]

    def lay_over(self, iterations: int) -> None:
        """Make the whole schedule one of so many steps."""
        self.options = laid_over(self.decisions.options, iterations)
        self.schedule.options = self.step.options = self.options
