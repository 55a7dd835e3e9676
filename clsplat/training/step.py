"""One training step, as the algorithm reads, and what may follow it."""

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
from clsplat.rendering.pipeline import Renderer
from clsplat.schedule import Plan, Schedule
from clsplat.training.model import Model
from clsplat.training.skipped_gradients import SkippedGradients

RESET_OPACITY = 0.01
Measured = dict[str, Any]  # name of a loss term -> what it measured in a view


class Step:
    """Takes training steps: gaussians, exposures and what is kept of their gradients.

    Parameters
    ----------
    renderer : that of the training.
    model : the gaussians, which steps change.
    extent : of the scene, world units.
    options : with scaled steps.
    exposures : colour transforms of the views, which steps change; None: no view has one.
    trains : called with positions and log_scales float32[N, 3], says which gaussians are trained,
        bool[N]; None: all. It is asked at each growth.

    Attributes
    ----------
    terms : of the loss (clsplat/loss/terms.py).
    statistics : screen gradients since the last growth or change of level.
    skipped : count of the gradients that were not finite.
    frozen : uint[N] on the device, not 0 for gaussians that are not trained; None: all are.
    pixel_pairs : pairs of gaussian and pixel so far: all pixels of a tile that it meets.
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
        self.frozen: Array | None = None
        self.freeze()
        self.pixel_pairs = 0

    def run(self, iteration: int, plan: Plan,
            samples: Iterable[TrainingSample]) -> list[Measured]:
        """Step `iteration`, from 1, on the mean loss of options.batch samples.

        Returns
        -------
        What the terms measured, a dict by their names a sample; still on the device, see `values`.
        """
        measured: list[Measured] = []
        used, views = self._used(plan.degree), self.options.batch
        found = (self._gradients_of(plan, sample, measured) for sample in samples)
        gradients = (next(found) if views == 1 else
                     batch_mean(self.device, self.model.count, views, found, used))
        rates = learning_rates(plan.decay, self.extent, self.options.opacity_rate)
        learned = {field.name: self.model.rows[field.name] for field in LEARNED}
        self.model.adam.step(learned, gradients, iteration, rates, used, self.frozen)
        return measured

    def values(self, measured: list[Measured]) -> dict[str, float]:
        """The numbers that the terms record of what `run` returned; waits."""
        return {name: value for term in self.terms for name, value in term.values(
            [found[term.name] for found in measured if term.name in found]).items()}

    def terms_in(self, plan: Plan) -> list[LossTerm]:
        """The terms that take part in the steps of a Plan."""
        return [term for term in self.terms if term.weight(plan)]

    def _gradients_of(self, plan, sample, measured):
        """The Gradients of one TrainingSample; adds to `measured` and statistics."""
        rows, exposures, photo = self.model.rows, self.exposures, sample.photo
        _, height, width = photo.shape
        terms = [term for term in self.terms_in(plan) if sample.source or not term.needs_source]
        frame = self.renderer.render(rows, sample.camera, width, height, plan.degree,
                                     with_depth=any(term.needs_depth for term in terms))
        self.pixel_pairs += frame.pair_count * self.device.tile**2
        image = exposures.apply(sample.view, frame.image) if exposures else frame.image
        found, grad = {}, FrameGradient()
        for term in terms:
            found[term.name] = term.add_to(grad, frame, image, sample, term.weight(plan))
        measured.append(found)
        if exposures:
            grad.image, partials = exposures.adjoint(sample.view, frame.image, grad.image)
            exposures.step(sample.view, partials)
        gradients = self.renderer.adjoint(rows, frame, grad.image, grad.depth, grad.transmittance)
        self.skipped.asked += len(gradients.rows) + bool(exposures)
        if self.frozen is not None:
            freeze_rows(self.device, gradients, self.frozen)
        if plan.gathers:
            self.statistics.accumulate(gradients, width, height)
        return gradients

    def _used(self, degree):
        """Field -> floats of a row that may change: inactive harmonics stay out."""
        used = {field.name: field.width(self.model.sh_degree) for field in LEARNED}
        return {**used, "sh_rest": 3 * degree * (degree + 2)}

    def densify(self, iteration: int, plan: Plan, schedule: Schedule,
                scoring_views: Callable[[], list[tuple[Array, Array]]]) -> dict[str, int] | None:
        """Growth and opacity reset after a step; returns what happened, or None.

        Parameters
        ----------
        iteration : of the step before, from 1.
        plan : of that step.
        schedule : asked how many gaussians may be added, and how they are chosen.
        scoring_views : gives packed cameras and photos of some training views, for a schedule that
            scores gaussians.
        """
        event = self._grow(iteration, plan, schedule, scoring_views) if plan.grows else None
        if plan.resets_opacity:
            self.model.limit_opacity(np.log(RESET_OPACITY / (1 - RESET_OPACITY)),
                                     None if self.frozen is None else self.frozen.download() == 0)
        return event

    def freeze(self) -> None:
        """Find anew which gaussians are frozen."""
        if self.trains:
            rows = (self.model.rows[name].download() for name in ("positions", "log_scales"))
            self.frozen = self.device.upload((~self.trains(*rows)).astype(np.uint32))

    def _grow(self, iteration, plan, schedule, scoring_views):
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
        gradient = np.where(frozen, -np.inf, gradient)  # what is around a block stays as it is
        grows = self._chosen(iteration, schedule, gradient, candidates, prunes, scores, rng)
        growth = plan_growth(candidates, grows, prunes, rng)
        model.regrow(growth)
        self.freeze()
        self.statistics.clear(model.count)
        return {"cloned": growth.cloned, "split": growth.split, "pruned": growth.pruned}

    def _chosen(self, iteration, schedule, gradient, candidates, prunes, scores, rng):
        """bool[N]: which gaussians are cloned or split; each adds one.

        gradient: -inf where none may grow; the schedule is asked about the others only.
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
        if room is not None:  # of what would go for its size, a split leaves two
            room -= int((prunes & (gradient >= threshold)).sum())
        return above_threshold(gradient, threshold, room)
