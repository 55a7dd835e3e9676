"""A copy of the model before an opacity reset or a change of level.

A run whose time budget ends too soon after one of them returns to it.
"""

from collections.abc import Sequence

import numpy as np

from clsplat.gaussians import LEARNED
from clsplat.loss.image_loss import image_loss, loss_value
from clsplat.rendering.project import Rows
from clsplat.training.part import ViewPass
from clsplat.training.step import Step


class Rollback:
    """Rows and moments of a model, in host memory.

    Attributes
    ----------
    iteration : steps taken before the copy.
    """

    def __init__(self, step: Step, iteration: int) -> None:
        model = step.model
        self.iteration = iteration
        model.catch_up()
        self._gaussians, self._moments = model.download(), model.adam.download()

    def restore_if_better(self, step: Step, samples: Sequence[ViewPass]) -> bool:
        """Restore the copy if its loss is smaller than that of the present model.

        Parameters
        ----------
        step : has the present model, and receives the copy.
        samples : training views.

        Returns
        -------
        Whether the copy was restored.
        """
        model = step.model
        model.catch_up()
        kept = {field.name: step.device.upload(self._gaussians.rows[field.name])
                for field in LEARNED}
        if not _loss(step, kept, samples) < _loss(step, model.rows, samples):
            return False
        model.adopt(self._gaussians)
        model.adam.upload(*self._moments)
        step.statistics.clear(model.count)
        step.rows_changed()
        return True


def _loss(step: Step, rows: Rows, samples: Sequence[ViewPass]) -> float:
    """The mean image loss of some views, without colour transforms."""
    losses = []
    for sample in samples:
        photo, (_, height, width) = sample.photo, sample.photo.shape
        frame = step.renderer.render(rows, sample.camera, width, height, step.options.sh_degree,
                                     backdrop=sample.backdrop)
        partials, _ = image_loss(step.device, frame.exposed, photo, step.options.ssim_weight)
        losses.append(loss_value(partials, 3 * height * width, step.options.ssim_weight)[0])
    return float(np.mean(losses))
