"""What each splat adds to an image: every splat against every pixel, front to back, no tiles.

Splats are a dict: means[N, 2] and conics[N, 3] (pixels), opacities[N].
"""

import numpy as np

ALPHA_MIN = 1 / 255
ALPHA_MAX = 0.99
TRANSMITTANCE_MIN = 1e-4


def contribution(splats, order, weights):
    """sums[N, 4] of the splats drawn in `order`, front first, over the pixels each is blended at:
    1, alpha T, alpha T weight, and the distance from its mean, pixels. weights[H, W]."""
    line, column = np.indices(weights.shape)
    transmittance = np.ones(weights.shape)
    ended = np.zeros(weights.shape, bool)
    sums = np.zeros((len(splats["opacities"]), 4))
    for k in order:
        dx, dy = column + 0.5 - splats["means"][k, 0], line + 0.5 - splats["means"][k, 1]
        alpha = _alpha(splats, k, dx, dy)
        drawn = (alpha >= ALPHA_MIN) & ~ended
        ended |= drawn & (transmittance * (1 - alpha) < TRANSMITTANCE_MIN)
        drawn &= ~ended
        blended = (alpha * transmittance)[drawn]
        sums[k] = (drawn.sum(), blended.sum(), blended @ weights[drawn], np.hypot(dx, dy)[drawn].sum())
        transmittance = np.where(drawn, transmittance * (1 - alpha), transmittance)
    return sums


def reaches(splats, k, pixels):
    """Whether splat k may be blended at any of the pixels bool[H, W], give or take rounding."""
    line, column = np.nonzero(pixels)
    dx, dy = column + 0.5 - splats["means"][k, 0], line + 0.5 - splats["means"][k, 1]
    return bool((_alpha(splats, k, dx, dy) > 0.99 * ALPHA_MIN).any())


def _alpha(splats, k, dx, dy):
    a, b, c = splats["conics"][k]
    power = -(a * dx**2 + 2 * b * dx * dy + c * dy**2) / 2
    return np.minimum(ALPHA_MAX, splats["opacities"][k] * np.exp(power))
