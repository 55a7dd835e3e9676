"""One training step, as the algorithm reads, and what may follow it."""

from dataclasses import dataclass

import numpy as np

from clsplat.densify.grow import Candidates, plan_growth
from clsplat.densify.scores import taming_scores
from clsplat.densify.select import above_threshold, by_score, half_of, highest
from clsplat.densify.statistics import Statistics
from clsplat.device import Array
from clsplat.gaussians import FIELDS, LEARNED
from clsplat.loss.image_loss import image_loss
from clsplat.loss.reproject import reproject
from clsplat.optimise.adam import freeze_rows
from clsplat.optimise.batch import batch_mean
from clsplat.optimise.rates import learning_rates
from clsplat.training.skipped import Skipped

RESET_OPACITY = 0.01


@dataclass(frozen=True, eq=False)
class TrainingSample:
    """What a step learns from.

    view: index of the view; camera: packed; photo: uchar[3, H, W]; pair: (photo, geometries,
    colours, row of both) of an adjacent view for `reproject`, or None.
    """

    view: int
    camera: Array
    photo: Array
    pair: tuple | None = None


class Step:
    """Everything a step needs: renderer, model, statistics and the options that never change.

    extent: scene extent, world units; options: TrainOptions with scaled steps; exposures:
    loss.exposure.Exposures or None; trains: of positions and log_scales float32[N, 3], which may
    change, bool[N]; None: all. It is asked at each growth; the others are `frozen`, uint[N] on the
    device.
    """

    def __init__(self, renderer, model, extent, options, exposures=None, trains=None):
        self.renderer, self.model, self.extent, self.options = renderer, model, extent, options
        self.device, self.exposures, self.trains = renderer.device, exposures, trains
        self.statistics = Statistics(self.device, model.count)
        self.skipped = Skipped(renderer.skipped, *([exposures.skipped] if exposures else []))
        self.frozen = None
        self.find_frozen()
        self.pixel_pairs = 0  # pairs of gaussian and pixel so far: all pixels of a tile it meets

    def run(self, iteration, plan, samples):
        """Step `iteration` (from 1) on the mean loss of options.batch Shots, an iterable; returns
        [(loss sums, still on the device; values of the photo), ...]."""
        losses, used, views = [], self._used(plan.degree), self.options.batch
        found = (self._gradients_of(plan, sample, losses) for sample in samples)
        gradients = (next(found) if views == 1 else
                     batch_mean(self.device, self.model.count, views, found, used))
        rates = learning_rates(plan.decay, self.extent, self.options.opacity_rate)
        learned = {field.name: self.model.rows[field.name] for field in LEARNED}
        self.model.adam.step(learned, gradients, iteration, rates, used, self.frozen)
        return losses

    def _gradients_of(self, plan, sample, losses):
        """The Gradients of one TrainingSample; adds to `losses` and statistics."""
        rows, exposures, photo = self.model.rows, self.exposures, sample.photo
        _, height, width = photo.shape
        frame = self.renderer.render(rows, sample.camera, width, height, plan.degree,
                                     with_depth=sample.pair is not None)
        self.pixel_pairs += frame.pair_count * self.device.tile**2
        image = exposures.apply(sample.view, frame.image) if exposures else frame.image
        sums, grad_image = image_loss(self.device, image, photo, self.options.ssim_weight)
        losses.append((sums, 3 * height * width))
        if exposures:
            grad_image = exposures.adjoint(sample.view, frame.image, grad_image)
        grad_depth = grad_transmittance = None
        if sample.pair is not None:
            blended = frame.blended
            _, grad_depth, grad_transmittance = reproject(
                self.device, blended.depth, blended.transmittance, photo, *sample.pair,
                plan.regularises)
        gradients = self.renderer.adjoint(rows, frame, grad_image, grad_depth, grad_transmittance)
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

    def densify(self, iteration, plan, schedule, scoring_views):
        """Growth and opacity reset after a step; returns what happened, or None.

        scoring_views: called without arguments, gives [(packed camera, photo), ...] of some
        training views, for a schedule that scores gaussians.
        """
        event = self._grow(iteration, plan, schedule, scoring_views) if plan.grows else None
        if plan.resets_opacity:
            self.model.limit_opacity(np.log(RESET_OPACITY / (1 - RESET_OPACITY)),
                                     None if self.frozen is None else self.frozen.download() == 0)
        return event

    def find_frozen(self):
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
        self.find_frozen()
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
        self.find_frozen()
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
