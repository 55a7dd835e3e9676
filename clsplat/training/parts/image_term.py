"""The difference between the image and its photo, which every training minimises."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from clsplat.device import Array
from clsplat.loss.image_loss import image_loss, loss_value
from clsplat.loss.options import ImageLossOptions
from clsplat.training.part import Inputs, Part, ViewPass

if TYPE_CHECKING:
    from clsplat.training.session import Session


class ImageTerm(Part):
    """L1 and D-SSIM of the image against its photo."""

    name = "image"
    Options = ImageLossOptions

    def __init__(self, ssim_weight: float = ImageLossOptions.ssim_weight) -> None:
        self.ssim_weight = ssim_weight

    def begin(self, session: Session) -> None:
        self.ssim_weight = session.options.ssim_weight

    def add_to(self, work: ViewPass, inputs: Inputs) -> tuple[Array, int]:
        image = work.frame.exposed
        partials, grad_image = image_loss(image.device, image, work.photo, self.ssim_weight)
        work.grad.add(image=grad_image)
        _, height, width = image.shape
        return partials, 3 * height * width

    def values(self, measured: list[tuple[Array, int]]) -> dict[str, float]:
        """The loss, mean |x - y| and mean SSIM, each a mean over the views."""
        by_view = [loss_value(partials, count, self.ssim_weight) for partials, count in measured]
        return dict(zip(("loss", "l1", "ssim"), np.mean(by_view, axis=0).tolist()))
