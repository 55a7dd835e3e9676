"""One training step, written as the algorithm reads, and the growth that may follow it."""

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.densify.grow import Candidates, plan_growth
from clsplat.densify.scores import taming_scores
from clsplat.densify.select import above_threshold, by_score, half_of, highest
from clsplat.densify.statistics import Statistics
from clsplat.device import Array
from clsplat.gaussians import FIELDS, LEARNED
from clsplat.loss.exposure import Exposures
from clsplat.loss.term import FrameGradient, LossTerm, TrainingSample
from clsplat.loss.terms import terms_of
from clsplat.optimise.adam import freeze_rows
from clsplat.optimise.batch import batch_mean
from clsplat.optimise.rates import learning_rates
from clsplat.options import TrainOptions
from clsplat.rendering.pipeline import Gradients, Renderer
from clsplat.schedule import Plan, Schedule
from clsplat.training.model import Model
from clsplat.training.skipped_gradients import SkippedGradients

RESET_OPACITY = 0.01
Measured = dict[str, Any]  # name of a loss term -> its measurements in a view


class Step:
    """Takes training steps, which change the gaussians and exposures.

    Parameters
    ----------
    renderer : of the training.
    model : the gaussians.
    extent : world units; size of the scene.
    options : with scaled steps.
    exposures : colour transforms of the views; None: views have none.
    trains : (positions, log_scales) float32[N, 3] -> bool[N], those that are trained; called
        at each round of growth; None: all are.

    Attributes
    ----------
    terms : terms of the loss (clsplat/loss/terms.py).
    statistics : screen gradients since the last growth or change of level.
    skipped : counts gradients that were not finite.
    pixel_pairs : pairs of a gaussian and a pixel so far; a tile counts with all its pixels.
    """

    def __init__(self, renderer: Renderer, model: Model, extent: float, options: TrainOptions,
                 exposures: Exposures | None = None,
                 trains: Callable[..., NDArray[np.bool_]] | None = None) -> None:
        self.renderer, self.model, self.extent, self.options = renderer, model, extent, options
        self.device, self.exposures, self.trains = renderer.device, exposures, trains
        self.terms = terms_of(self.device, options)
        self.statistics = Statistics(self.device, model.count)
        self.skipped = SkippedGradients(
            renderer.skipped, *([exposures.skipped] if exposures else []))
        self.freeze()
        self.pixel_pairs = 0

    @property
    def frozen(self) -> Array | None:
        """uint[N] on the device; not 0 for gaussians that are not trained; None: all are."""
        return self.model.frozen

    def run(self, iteration: int, plan: Plan,
            samples: Iterable[TrainingSample]) -> list[Measured]:
        """Take a step on the mean loss of options.batch samples.

        Parameters
        ----------
        iteration : number of the step, from 1.
        plan : the schedule's decisions for it.
        samples : training views; read one at a time.

        Returns
        -------
        The measurements of each sample, still on the device; see `values`.
        """
        measured: list[Measured] = []
        used, views = self._used(plan.degree), self.options.batch
        each = (self._gradients_of(plan, sample, measured) for sample in samples)
        gradients = (next(each) if views == 1 else
                     batch_mean(self.device, self.model.count, views, each, used))
        rates = learning_rates(plan.decay, self.extent, self.options.opacity_rate)
        learned = {field.name: self.model.rows[field.name] for field in LEARNED}
        self.model.adam.step(learned, gradients, iteration, rates, used, self.frozen)
        return measured

    def values(self, measured: list[Measured]) -> dict[str, float]:
        """The values of the loss terms, from what `run` returned; waits."""
        return {name: value for term in self.terms for name, value in term.values(
            [view[term.name] for view in measured if term.name in view]).items()}

    def terms_in(self, plan: Plan) -> list[LossTerm]:
        """The terms of the loss that a plan uses."""
        return [term for term in self.terms if term.weight(plan)]

    def _gradients_of(self, plan: Plan, sample: TrainingSample, measured: list[Measured]
                      ) -> Gradients:
        """The gradients of one sample; adds to `measured` and to the statistics."""
        rows, exposures, photo = self.model.rows, self.exposures, sample.photo
        _, height, width = photo.shape
        terms = [term for term in self.terms_in(plan) if sample.source or not term.needs_source]
        self.model.catch_up(sample.camera)
        frame = self.renderer.render(rows, sample.camera, width, height, plan.degree,
                                     with_depth=any(term.needs_depth for term in terms))
        self.pixel_pairs += frame.pair_count * self.device.tile**2
        image = exposures.apply(sample.view, frame.image) if exposures else frame.image
        grad = FrameGradient()
        measured.append({term.name: term.add_to(grad, frame, image, sample, term.weight(plan))
                         for term in terms})
        if exposures:
            grad.image, partials = exposures.adjoint(sample.view, frame.image, grad.image)
            exposures.step(sample.view, partials)
        gradients = self.renderer.adjoint(rows, frame, grad.image, grad.depth, grad.transmittance)
        self.skipped.requested += len(gradients.rows) + bool(exposures)
        if self.frozen is not None:
            freeze_rows(self.device, gradients, self.frozen)
        if plan.gathers:
            self.statistics.accumulate(gradients, width, height)
        return gradients

    def _used(self, degree: int) -> dict[str, int]:
        """Field -> floats of a row that are trained: without inactive spherical harmonics."""
        used = {field.name: field.width(self.model.sh_degree) for field in LEARNED}
        return {**used, "sh_rest": 3 * degree * (degree + 2)}

    def densify(self, iteration: int, plan: Plan, schedule: Schedule,
                scoring_views: Callable[[], list[tuple[Array, Array]]]) -> dict[str, int] | None:
        """Do the round of growth and the opacity reset that follow a step.

        Parameters
        ----------
        iteration : number of the step, from 1.
        plan : of that step.
        schedule : decides how many gaussians are added, and how they are selected.
        scoring_views : returns packed cameras and photos of some training views, for a schedule
            that scores gaussians.

        Returns
        -------
        How many gaussians were cloned, split and pruned; None without growth.
        """
        if plan.grows or plan.resets_opacity:
            self.model.catch_up()
        event = self._grow(iteration, plan, schedule, scoring_views) if plan.grows else None
        if plan.resets_opacity:
            self.model.limit_opacity(np.log(RESET_OPACITY / (1 - RESET_OPACITY)),
                                     None if self.frozen is None else self.frozen.download() == 0)
        return event

    def freeze(self) -> None:
        """Determine which gaussians are frozen."""
        if self.trains:
            rows = (self.model.rows[name].download() for name in ("positions", "log_scales"))
            self.model.frozen = self.device.upload((~self.trains(*rows)).astype(np.uint32))

    def _grow(self, iteration: int, plan: Plan, schedule: Schedule,
              scoring_views: Callable[[], list[tuple[Array, Array]]]) -> dict[str, int]:
        model, options = self.model, self.options
        rows = {field.name: model.rows[field.name].download() for field in FIELDS
                if field.name in model.rows and not field.name.startswith("sh_")}
        # counter-based: a resumed run draws the same numbers
        rng = np.random.default_rng([options.seed, iteration])
        gradient = self.statistics.mean_gradient()
        candidates = Candidates(rows, self.extent, options, plan.prunes_large)
        self.freeze()
        frozen = (np.zeros(model.count, bool) if self.frozen is None
                  else self.frozen.download() > 0)
        prunes = candidates.prunes & ~frozen
        scores = None
        if schedule.selection == "score":
            scores = taming_scores(self.renderer, model.rows, scoring_views(), plan.degree,
                                   options.ssim_weight, gradient)
            if schedule.spares_half(iteration):
                prunes = half_of(prunes, scores, rng)
        gradient = np.where(frozen, -np.inf, gradient)  # frozen ones stay
        grows = self._selected(iteration, schedule, gradient, candidates, prunes, scores, rng)
        growth = plan_growth(candidates, grows, prunes, rng)
        model.regrow(growth)
        self.freeze()
        self.statistics.clear(model.count)
        return {"cloned": growth.cloned, "split": growth.split, "pruned": growth.pruned}

    def _selected(self, iteration: int, schedule: Schedule, gradient: NDArray[np.floating],
                  candidates: Candidates, prunes: NDArray[np.bool_],
                  scores: NDArray[np.floating] | None, rng: np.random.Generator
                  ) -> NDArray[np.bool_]:
        """The gaussians [N] that are cloned or split, each of which adds one.

        `gradient` is -inf for frozen gaussians, which the schedule does not count.
        """
        threshold, limit = self.options.grow_threshold, self.options.max_gaussians
        counted = ~prunes & (gradient != -np.inf)
        count = int(counted.sum())
        target = schedule.target(iteration, count, int((gradient >= threshold)[counted].sum()))
        if limit:
            limit -= int((~prunes & ~counted).sum())
            target = limit if target is None else min(target, limit)
        room = None if target is None else max(0, target - count)
        if schedule.selection == "score":
            return by_score(np.where(prunes, 0, scores), gradient, threshold, candidates.is_small,
                            room, rng)
        if schedule.selection == "highest":
            return highest(np.where(prunes, 0, gradient), room)
        if room is not None:  # a split replaces a gaussian that is too large by two
            room -= int((prunes & (gradient >= threshold)).sum())
        return above_threshold(gradient, threshold, room)
