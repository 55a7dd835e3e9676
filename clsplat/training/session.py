"""The state of a training, built in one place for trainings, estimates and benchmarks.

A session has no files and no clock; of its progress it reports only what is being done now.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from clsplat.device import Array, Device
from clsplat.evaluation.held_out_responses import Predicted, predicted_responses
from clsplat.gaussians import Gaussians
from clsplat.loss.exposure import Exposures
from clsplat.loss.term import SourceView, TrainingSample
from clsplat.optimise.pose import Poses
from clsplat.options import TrainOptions
from clsplat.placement.corrections import Correction, typical_depth
from clsplat.rendering.pipeline import Renderer
from clsplat.response import Response
from clsplat.scene import Scene, View, corrected_views
from clsplat.schedule import Plan, Schedule, laid_over
from clsplat.schedule.plan import size_at
from clsplat.training.dense_start import first_gaussians
from clsplat.training.depth_maps import DepthMapsOnDevice
from clsplat.training.initialise import initial_responses
from clsplat.training.layers import Layers
from clsplat.training.model import Model
from clsplat.training.photos import Photos, decoded
from clsplat.training.prepare import PreparedScene, prepare
from clsplat.training.progress import SilentProgress
from clsplat.training.robust import Seen, find_outliers, is_due, share_of
from clsplat.training.source_views import SourceViews
from clsplat.training.step import Step
from clsplat.training.units import MOST_PENDING

FEW_PHOTOS = 3  # of steps that may be repeated, where photos do not stay on the device
SCORING_VIEWS = 10  # for a schedule that scores gaussians


class Session:
    """The state of a training after `iteration` steps.

    Parameters
    ----------
    prepared : the scene.
    device : of the training.
    gaussians : the initial ones.
    schedule : decides level and growth; None: the caller does, and gives `photos`.
    photos : of the training views; None: photos at the levels of the schedule.
    layers : of a block that has surroundings; None: they are drawn.
    progress : receives what is being done.
    folder : where photos wait for their use (`Photos`).
    level : at which training begins; 0: the first one of the schedule.

    Attributes
    ----------
    schedule : of the steps; missing where the caller decides.
    step : takes steps; has the model, the exposures and the statistics.
    source_views : None if no loss term compares with another view.
    layers : what a block's views show of its surroundings; None: nothing is drawn as layers.
    level : down-sampling factor of the training images.
    cameras : packed cameras of the training views at that level.
    options : may be replaced between steps (`lay_over`).
    start_seconds : that finding the initial gaussians took.
    disturbed_at : step of the latest search for outliers, change of level or reset of opacities.
    """

    def __init__(self, prepared: PreparedScene, device: Device, gaussians: Gaussians,
                 schedule: Schedule | None = None, photos: Photos | None = None,
                 progress: SilentProgress | None = None, layers: Layers | None = None,
                 folder: Path | None = None, level: float = 0.0) -> None:
        self.device, self.progress = device, progress or SilentProgress()
        if schedule is not None:
            self.schedule = schedule
        self.scene, self.decisions = prepared.scene, prepared.decisions
        self.train_views, self.test_views = prepared.train_views, prepared.test_views
        self.options = options = prepared.options
        self.renderer = Renderer(device, options.sh_degree, prepared.near, options.antialiased,
                                 options.background)
        self.photos = photos or Photos(device, self.train_views, self.schedule.levels,
                                       folder=folder, level=level)
        self.layers = layers
        if prepared.surroundings and not layers:
            self.layers = Layers(device, self.scene, prepared.surroundings, prepared.near, options)
        self._draw_layers()  # before there is a model, as that needs memory
        model = Model(device, gaussians, options.engine, options.optimizer == "dense")
        exposures = None
        if self.layers:  # the step puts them in front where it exposes the image
            exposures = Exposures(device, len(self.train_views), learns=False)
        if options.exposure == "on":
            initial = initial_responses(self.scene, self.train_views)
            exposures = Exposures(
                # blocks that learned their own would not agree
                device, len(self.train_views), learns=initial is None or self.scene.region is None,
                initial=None if initial is None else np.array([
                    response.transform for response in initial]),
                lenses=prepared.lenses)
        poses = None
        if options.poses == "on":
            cameras = [view.camera for view in self.train_views]
            poses = Poses(device, cameras, typical_depth(cameras, self.scene.points))
        self.step = Step(self.renderer, model, self.scene.extent, options, exposures, poses,
                         prepared.trains)
        neighbours = self.decisions.neighbours
        self.source_views = (SourceViews(device, neighbours, exposures, options.seed)
                             if neighbours else None)
        self.depths = DepthMapsOnDevice(device, self.scene.unit) if options.depth else None
        self.iteration, self.level, self.start_seconds = 0, 0.0, 0.0
        self.use_level(self.photos.level)

    @classmethod
    def build(cls, scene: Scene, options: TrainOptions, device: Device,
              progress: SilentProgress | None = None,
              gaussians: Gaussians | None = None, folder: Path | None = None,
              level: float = 0.0) -> Session:
        """Build a session, and read all photos, held-out ones too.

        Parameters
        ----------
        scene : as it was read.
        options : as the user gave them.
        device : of the training.
        progress : receives what is being done.
        gaussians : those of a resumed run; None: the initial ones.
        folder : where photos wait for their use (`Photos`).
        level : of a resumed run; 0: the first one.

        Raises
        ------
        InputError : for a scene, option or photo that cannot be used.
        """
        progress = progress or SilentProgress()
        progress.phase("planning")
        prepared = prepare(scene, options, device)
        gaussians, seconds = ((gaussians, 0.0) if gaussians else
                              first_gaussians(device, prepared, progress))
        schedule = prepared.schedule(gaussians)
        progress.phase("reading photos")
        for _ in decoded(prepared.test_views):
            pass  # a damaged photo would stop the run at its evaluation
        session = cls(prepared, device, gaussians, schedule, progress=progress, folder=folder,
                      level=level)
        session.start_seconds = seconds
        return session

    @property
    def model(self) -> Model:
        """The gaussians, after all steps that were taken; waits for these."""
        return self.step.model

    def use_level(self, level: float) -> bool:
        """Train on images `level` times smaller from now on; returns whether that is a change."""
        if level == self.level:
            return False
        self.level = level
        self.progress.phase(f"reading photos at {size_at(level)}")
        self.photos.use(level)
        self._draw_layers()
        cameras = [view.camera for view in self.photos.views]
        if self.source_views:
            self.source_views.use(cameras)
        if self.depths:
            self.depths.use(self.photos.views)
        self.cameras = [self.renderer.pack(camera) for camera in cameras]
        self.step.begin_level()
        self.disturbed_at = self.iteration
        # pending steps hold their photos, which elsewhere come and go
        stays = self.photos.resident and (not self.layers or self.layers.resident)
        self.step.units.most_pending = MOST_PENDING if stays else 1 + FEW_PHOTOS
        return True

    def _draw_layers(self) -> None:
        """Draw the layers of the photos' level, if there are any."""
        if self.layers:
            size = size_at(self.photos.level)
            self.progress.phase(f"drawing what surrounds the block at {size}")
            self.layers.use(self.photos.level, self.photos.views, self.photos.spare_bytes)

    def sample(self, view: int, number: int, plan: Plan) -> TrainingSample:
        """The training sample of a view.

        Parameters
        ----------
        view : index of the training view.
        number : how many views have been trained on, with this one.
        plan : of the step.
        """
        pair, source = self._pair(view, number, plan), None
        if pair:
            row, other = pair
            assert self.source_views is not None  # it has drawn the pair
            source = SourceView(self.photos[other], self.source_views.geometries,
                                self.source_views.colours, row)
        return TrainingSample(view, self.cameras[view], self.photos[view], source,
                              self.depths[view] if self.depths else None,
                              self.train_views[view].may_have_mask,
                              self.layers[view] if self.layers else None)

    def expect(self, view: int, number: int, plan: Plan) -> None:
        """Begin to read the photos that `sample` will need; same arguments."""
        self.photos.expect(view)
        pair = self._pair(view, number, plan)
        if pair:
            self.photos.expect(pair[1])

    def _pair(self, view: int, number: int, plan: Plan) -> tuple[int, int] | None:
        """(row of a pair, source view) if a term of the loss needs one."""
        if self.source_views and any(term.needs_source for term in self.step.terms_in(plan)):
            return self.source_views.drawn(number, view)
        return None

    def predicted(self) -> Predicted | None:
        """The responses of all views, for an evaluation; None without exposures."""
        return predicted_responses(self.scene.views, self.responses())

    def responses(self) -> dict[str, Response]:
        """The learned responses of the training views by name; empty without exposures."""
        if self.options.exposure != "on":
            return {}
        exposures = self.step.exposures
        assert exposures is not None  # the option is on
        return {view.name: response
                for view, response in zip(self.train_views, exposures.responses())}

    def corrections(self) -> dict[str, Correction]:
        """The corrections of the poses of training views by name, in units of the scene; empty
        where poses are not corrected."""
        if not self.step.poses:
            return {}
        return {view.name: correction for view, correction in zip(
            self.train_views, self.step.poses.corrections())}

    def corrected_views(self) -> tuple[View, ...]:
        """The training views with the corrected poses."""
        return corrected_views(self.train_views, self.corrections())

    def recentre(self) -> None:
        """Restore the initial mean of the exposures and of the poses; called once an epoch."""
        if self.step.poses:
            self.step.poses.recentre()
        if self.step.exposures:
            self.step.exposures.recentre()
            if self.source_views:
                self.source_views.compare_colours()

    def scoring_views(self) -> list[TrainingSample]:
        """Random training views, others at each step."""
        rng = np.random.default_rng([self.options.seed, 3, self.iteration])
        count = len(self.train_views)
        chosen = rng.choice(count, min(SCORING_VIEWS, count), replace=False)
        cameras = self.corrected_cameras()
        return [TrainingSample(i, cameras[i], self.photos[i],
                               layers=self.layers[i] if self.layers else None)
                for i in chosen.tolist()]

    def corrected_cameras(self) -> list[Array]:
        """Packed cameras of the training views at this level, with their poses as learned."""
        if not self.step.poses:
            return self.cameras
        return [self.renderer.pack(correction.applied(view.camera)) for correction, view
                in zip(self.step.poses.corrections(), self.photos.views)]

    def looks_for_outliers(self, plan: Plan) -> bool:
        """Whether `ignore_outliers` is due before the next step, which has this plan."""
        options = self.decisions.options
        return options.robust == "on" and is_due(
            self.iteration - self.disturbed_at, options.iterations,
            -(-len(self.train_views) // options.batch), plan.level != self.level)

    def ignore_outliers(self, degree: int) -> dict[str, float]:
        """Find the pixels of all training photos that are left out from now on; waits.

        Parameters
        ----------
        degree : of the spherical harmonics that are used.

        Returns
        -------
        For the record: the shares of all pixels, and of those of the photo with most.
        """
        self.model.catch_up()
        self.step.release()  # these frames have other sizes
        cells = find_outliers(self.renderer, self.model.rows, degree, self.step.exposures,
                              self._seen)
        self.device.trim()
        self.photos.ignore(cells)
        self.disturbed_at = self.iteration
        return {"share": round(share_of(cells), 6),
                "most": round(max(float(each.mean()) for each in cells), 6)}

    def _seen(self) -> Iterator[Seen]:
        """All training views at this level, with their photos."""
        for index, camera in enumerate(self.corrected_cameras()):
            photo = self.photos.unweighed(index)
            yield Seen(index, camera, photo[:3], photo[3] > 0,
                       self.layers[index] if self.layers else None)

    def lay_over(self, iterations: int) -> None:
        """Fit the whole schedule to a number of steps, or to `Decisions.most_steps`."""
        self.options = laid_over(self.decisions.options, min(iterations, self.decisions.most_steps))
        self.schedule.options = self.step.options = self.options
