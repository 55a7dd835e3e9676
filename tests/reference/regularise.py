"""L1 regularisation of opacities and sizes (Kheradmand et al. 2024), in float64."""

import numpy as np


def regularisation(logits, log_scales, opacity_weight, scale_weight):
    """Its value for the gaussians that a view sees: logits float64[V], log_scales float64[V, 3]."""
    return opacity_weight * np.mean(1 / (1 + np.exp(-logits))) + scale_weight * np.mean(np.exp(log_scales))


def regularise(logits, log_scales, opacity_weight, scale_weight):
    """Its gradients by logits float64[V] and by log_scales float64[V, 3]."""
    opacity = 1 / (1 + np.exp(-logits))
    return (opacity_weight * opacity * (1 - opacity) / logits.size, scale_weight * np.exp(log_scales) / log_scales.size)
