"""Screen gradients and visibility of each gaussian, summed over views (cl/project.cl)."""

import numpy as np
from numpy.typing import NDArray

from clsplat.device import Array, Device


class Statistics:
    """Sums over the views since the last `clear`: lengths of screen gradients real[N], NDC units,
    and how many views saw a gaussian, uint[N]."""

    def __init__(self, device: Device, count: int) -> None:
        self.device = device
        self.clear(count)

    def clear(self, count: int) -> None:
        """Start again for `count` gaussians."""
        self.grad_norm_sum = self.device.zeros(count)
        self.seen_count = self.device.zeros(count, np.uint32)

    @property
    def sums(self) -> tuple[Array, Array]:
        """Both arrays, for `Renderer.adjoint`, which adds a view."""
        return self.grad_norm_sum, self.seen_count

    def mean_gradient(self) -> NDArray[np.floating]:
        """float[N]: the mean screen gradient over the views that saw each gaussian; waits."""
        sums, counts = self.grad_norm_sum.download(), self.seen_count.download()
        means: NDArray[np.floating] = sums / np.maximum(counts, 1)
        return means
