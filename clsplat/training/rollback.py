"""A copy of the model from before its opacities are reset or its level changes, for a time budget
that ends too soon after it."""

from collections.abc import Sequence

import numpy as np

from clsplat.device import Array
from clsplat.loss.image_loss import image_loss, loss_value
from clsplat.training.model import Model
from clsplat.training.step import Step


class Rollback:
    """Rows and moments of a Step's model, in host memory.

    Attributes
    ----------
    iteration : steps taken when it was copied.
    """

    def __init__(self, step: Step, iteration: int) -> None:
        model = step.model
        self.iteration = iteration
        self._gaussians, self._moments = model.download(), model.adam.download(model.count)

    def restore_if_better(self, step: Step, samples: Sequence[tuple[Array, Array]]) -> bool:
        """Give the copy back to `step` where its loss is smaller; whether it was.

        Parameters
        ----------
        step : whose model it is compared with.
        samples : packed cameras and photos of training views.
        """
        now, model = _loss(step, samples), step.model
        step.model = Model(step.device, self._gaussians, step.options.engine,
                           step.options.optimizer == "dense")
        if not _loss(step, samples) < now:
            step.model = model
            return False
        step.model.adam.upload(*self._moments)
        step.statistics.clear(step.model.count)
        step.freeze()
        return True


def _loss(step, samples):
    """The mean loss of some views, without a colour transform."""
    found = []
    for camera, photo in samples:
        _, height, width = photo.shape
        frame = step.renderer.render(step.model.rows, camera, width, height,
                                     step.options.sh_degree)
        sums, _ = image_loss(step.device, frame.image, photo, step.options.ssim_weight)
        found.append(loss_value(sums, 3 * height * width, step.options.ssim_weight)[0])
    return float(np.mean(found))
