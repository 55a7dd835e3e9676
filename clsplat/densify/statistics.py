"""Screen gradients and visibility of each gaussian, summed over views (cl/statistics.cl)."""

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import FRAME_COUNTS
from clsplat.device import Array, ArraySpec, Device, Kernel, each
from clsplat.rendering.pipeline import Gradients

ACCUMULATE = Kernel("statistics.cl", "accumulate", each("V"), half_width="real",
                    half_height="real", counts=("uint", FRAME_COUNTS), rows=("uint", "V"),
                    grad_means=("real", "V", 2), grad_norm_sum=("real", "N"),
                    seen_count=("uint", "N"))


class Statistics:
    """Sums over the views since the last `clear`.

    Attributes
    ----------
    grad_norm_sum : real[N], lengths of screen gradients, NDC units.
    seen_count : uint[N], how many views saw a gaussian.
    """

    grad_norm_sum: Array
    seen_count: Array

    def __init__(self, device: Device, count: int) -> None:
        self.device = device
        self.clear(count)

    @staticmethod
    def arrays(count: int) -> dict[str, ArraySpec]:
        """The arrays for a number of gaussians, by attribute."""
        return {"grad_norm_sum": ArraySpec((count,)), "seen_count": ArraySpec((count,), np.uint32)}

    def clear(self, count: int) -> None:
        """Start again for `count` gaussians."""
        for name, spec in self.arrays(count).items():
            setattr(self, name, self.device.zeros(*spec))

    def accumulate(self, gradients: Gradients, width: int, height: int) -> None:
        """Add the gradients of one view, whose image has this size in pixels."""
        self.device.launch(
            ACCUMULATE, half_width=width / 2, half_height=height / 2, counts=gradients.counts,
            rows=gradients.rows, grad_means=gradients.means, grad_norm_sum=self.grad_norm_sum,
            seen_count=self.seen_count)

    def mean_gradient(self) -> NDArray[np.floating]:
        """float[N]: the mean screen gradient over the views that saw each gaussian; waits."""
        return self.grad_norm_sum.download() / np.maximum(self.seen_count.download(), 1)
