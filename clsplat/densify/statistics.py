"""Screen gradients and visibility of each gaussian, summed over views (cl/statistics.cl)."""

import numpy as np

from clsplat.device import ArraySpec, Kernel, each

ACCUMULATE = Kernel("statistics.cl", "accumulate", each("count"), count="uint",
                    half_width="real", half_height="real", rows=("uint", "V"),
                    grad_means=("real", "V", 2), grad_norm_sum=("real", "N"),
                    seen_count=("uint", "N"))


class Statistics:
    """grad_norm_sum real[N], NDC units; seen_count uint[N]: since the last `clear`."""

    def __init__(self, device, count):
        self.device = device
        self.clear(count)

    @staticmethod
    def arrays(count: int) -> dict[str, ArraySpec]:
        """The arrays for so many gaussians."""
        return {"grad_norm_sum": ArraySpec((count,)), "seen_count": ArraySpec((count,), np.uint32)}

    def clear(self, count: int) -> None:
        """Start again for `count` gaussians."""
        for name, spec in self.arrays(count).items():
            setattr(self, name, self.device.zeros(*spec))

    def accumulate(self, gradients, width, height):
        """Add one view's `render.pipeline.Gradients`; width, height: of its image, pixels."""
        self.device.launch(
            ACCUMULATE, count=len(gradients.rows), half_width=width / 2, half_height=height / 2,
            rows=gradients.rows, grad_means=gradients.means, grad_norm_sum=self.grad_norm_sum,
            seen_count=self.seen_count)

    def mean_gradient(self):
        """float[N] on the host: the mean screen gradient over the views that saw each gaussian."""
        return self.grad_norm_sum.download() / np.maximum(self.seen_count.download(), 1)
