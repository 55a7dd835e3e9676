"""One training step, as the algorithm reads, and what may follow it."""

import numpy as np

from clsplat.densify.grow import plan_growth
from clsplat.densify.statistics import Statistics
from clsplat.gaussians import FIELDS
from clsplat.loss.image_loss import image_loss
from clsplat.optimise.rates import learning_rates

RESET_OPACITY = 0.01


class Step:
    """Everything a step needs: renderer, model, statistics and the options that never change.

    extent: scene extent, world units; options: TrainOptions with scaled steps.
    """

    def __init__(self, renderer, model, extent, options):
        self.renderer, self.model, self.extent, self.options = renderer, model, extent, options
        self.device = renderer.device
        self.statistics = Statistics(self.device, model.count)

    def take(self, iteration, plan, camera, photo):
        """Step `iteration` (from 1) on one view; returns the loss sums, still on the device.

        camera: packed; photo: uchar[3, H, W].
        """
        model, options = self.model, self.options
        _, height, width = photo.shape
        rows = model.rows
        frame = self.renderer.render(rows, camera, width, height, plan.degree)
        sums, grad_image = image_loss(self.device, frame.image, photo, options.ssim_weight)
        gradients = self.renderer.adjoint(rows, frame, grad_image)
        rates = learning_rates(iteration - 1, options.iterations, self.extent)
        model.adam.step(rows, gradients, iteration, rates, self._used(plan.degree))
        if plan.gathers:
            self.statistics.accumulate(gradients, width, height)
        return sums

    def _used(self, degree):
        """Field -> floats of a row that may change: inactive harmonics stay out."""
        used = {field.name: field.width(self.model.sh_degree) for field in FIELDS}
        return {**used, "sh_rest": 3 * degree * (degree + 2)}

    def follow(self, iteration, plan):
        """Growth and opacity reset after a step; returns what happened, or None."""
        event = self._grow(iteration, plan) if plan.grows else None
        if plan.resets_opacity:
            self.model.limit_opacity(np.log(RESET_OPACITY / (1 - RESET_OPACITY)))
        return event

    def _grow(self, iteration, plan):
        model, options = self.model, self.options
        names = ("positions", "log_scales", "quaternions", "opacity_logits")
        rows = {name: model.rows[name].download() for name in names}
        # counter-based: a resumed run draws the same numbers
        rng = np.random.default_rng([options.seed, iteration])
        growth = plan_growth(self.statistics.mean_gradient(), rows, self.extent, options,
                             plan.prunes_large, rng)
        model.regrow(growth)
        self.statistics.clear(model.count)
        return {"cloned": growth.cloned, "split": len(growth.positions) // 2,
                "pruned": growth.pruned}
