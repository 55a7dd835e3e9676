"""Sums that decide densification: screen gradients in NDC units, and how often a row was seen."""

import numpy as np


def accumulate(grad_norm_sum, seen_count, grad_means, visible, width, height):
    """New (grad_norm_sum[N], seen_count[N]) after a view.

    grad_means[N, 2]: gradient by the pixel position of each splat; times W/2, H/2 it is that by the
    position in NDC, in which the published thresholds are stated.
    """
    norm = np.hypot(grad_means[:, 0] * width / 2, grad_means[:, 1] * height / 2)
    return grad_norm_sum + np.where(visible, norm, 0), seen_count + visible
