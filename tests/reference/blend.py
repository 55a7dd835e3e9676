"""Splats to an image, front to back, and the adjoint: every splat against every pixel, no tiles.

Splats are a dict: means[N, 2] and conics[N, 3] (pixels), opacities[N], colours[N, C], depths[N].
`order` lists the splats to draw, front first.
"""

import numpy as np

ALPHA_MIN = 1 / 255
ALPHA_MAX = 0.99
TRANSMITTANCE_MIN = 1e-4


def blend(splats, order, width, height, background, smooth=False, with_depth=False, depth_at=0.0):
    """image[C, H, W], transmittance[H, W], depth[H, W] (zero unless with_depth).

    depth is sum(alpha T z), without background; depth_at: z of the last splat that is blended while
    T is greater. smooth: fade alpha in from 1/255 to 2/255 instead of switching it on, so that the
    image is continuously differentiable; for gradient tests.
    """
    pixels, channels = height * width, splats["colours"].shape[1]
    image, depth, transmittance = np.zeros((channels, pixels)), np.zeros(pixels), np.ones(pixels)
    for touch in _touches(splats, order, width, height, smooth):
        weight = touch["alpha"] * touch["before"]
        image[:, touch["pixels"]] += splats["colours"][touch["splat"]][:, None] * weight
        if depth_at:
            depth[touch["pixels"][touch["before"] > depth_at]] = splats["depths"][touch["splat"]]
        else:
            depth[touch["pixels"]] += splats["depths"][touch["splat"]] * weight * with_depth
        transmittance[touch["pixels"]] = touch["before"] * (1 - touch["alpha"])
    image += np.reshape(background, (channels, 1)) * transmittance
    shape = height, width
    return image.reshape(channels, *shape), transmittance.reshape(shape), depth.reshape(shape)


def blend_adjoint(
    splats, order, width, height, background, grad_image, grad_depth=None, grad_transmittance=None, smooth=False
):
    """Gradients like `splats` from grad_image[C, H, W] and, if given, grad_depth[H, W] and
    grad_transmittance[H, W]."""
    pixels, channels = height * width, len(grad_image)
    grad_image = grad_image.reshape(channels, pixels)
    grad_depth = np.zeros(pixels) if grad_depth is None else grad_depth.reshape(pixels)
    result = {name: np.zeros(np.shape(splats[name])) for name in ("means", "conics", "opacities", "colours", "depths")}
    touches = list(_touches(splats, order, width, height, smooth))
    # what lies behind the splat at hand, as seen through it, times the cotangent
    behind = (np.reshape(background, (channels, 1)) * grad_image).sum(axis=0)
    if grad_transmittance is not None:
        behind += grad_transmittance.reshape(pixels)
    for touch in reversed(touches):
        k, at, alpha = touch["splat"], touch["pixels"], touch["alpha"]
        before = touch["before"]
        weight = alpha * before
        own = splats["colours"][k] @ grad_image[:, at] + splats["depths"][k] * grad_depth[at]
        result["colours"][k] += grad_image[:, at] @ weight
        result["depths"][k] += grad_depth[at] @ weight
        grad_alpha0 = before * (own - behind[at]) * touch["slope"]
        behind[at] = alpha * own + (1 - alpha) * behind[at]

        result["opacities"][k] += grad_alpha0 @ touch["falloff"]
        grad_power = grad_alpha0 * splats["opacities"][k] * touch["falloff"]
        dx, dy = touch["offset"]
        a, b, c = splats["conics"][k]
        result["means"][k] += grad_power @ (a * dx + b * dy), grad_power @ (b * dx + c * dy)
        result["conics"][k] -= (grad_power @ dx**2 / 2, grad_power @ (dx * dy), grad_power @ dy**2 / 2)
    return result


def fragile_pixels(splats, order, width, height, tolerance=1e-4):
    """bool[H, W]: pixels where some comparison (alpha with 1/255 or .99, T with 1e-4) is decided
    by less than `tolerance`, relative. Lower precision may decide otherwise there, so tests give
    these pixels no cotangent and do not compare them."""
    fragile = np.zeros(height * width, bool)
    transmittance = np.ones(height * width)
    for k in order:
        alpha0 = splats["opacities"][k] * _falloff(splats, k, width, height)[0]
        alpha = np.where(alpha0 < ALPHA_MIN, 0, np.minimum(ALPHA_MAX, alpha0))
        alive = transmittance >= TRANSMITTANCE_MIN
        transmittance = np.where(alive, transmittance * (1 - alpha), transmittance)
        for value, threshold in ((alpha0, ALPHA_MIN), (alpha0, ALPHA_MAX), (transmittance, TRANSMITTANCE_MIN)):
            fragile |= alive & (np.abs(value - threshold) <= tolerance * threshold)
    return fragile.reshape(height, width)


def _touches(splats, order, width, height, smooth):
    """For each splat in order, where it adds to the image: pixel indices, alpha and its derivative
    (`slope`) by alpha0 = opacity * falloff, offset from the mean, and transmittance `before` it."""
    transmittance = np.ones(height * width)
    stopped = np.zeros(height * width, bool)
    for k in order:
        falloff, offset = _falloff(splats, k, width, height)
        alpha0 = splats["opacities"][k] * falloff
        alpha, slope = np.minimum(ALPHA_MAX, alpha0), (alpha0 < ALPHA_MAX).astype(float)
        if smooth:
            u = np.clip((alpha0 - ALPHA_MIN) / ALPHA_MIN, 0, 1)
            slope = slope * u**2 * (3 - 2 * u) + alpha * 6 * u * (1 - u) / ALPHA_MIN
            alpha = alpha * u**2 * (3 - 2 * u)
        drawn = (alpha0 >= ALPHA_MIN) & ~stopped
        stopped |= drawn & (transmittance * (1 - alpha) < TRANSMITTANCE_MIN)
        at = np.flatnonzero(drawn & ~stopped)
        yield {
            "splat": k,
            "pixels": at,
            "alpha": alpha[at],
            "slope": slope[at],
            "falloff": falloff[at],
            "offset": offset[:, at],
            "before": transmittance[at],
        }
        transmittance[at] *= 1 - alpha[at]


def _falloff(splats, k, width, height):
    """exp(-q/2) [H W] of splat k, and the offsets [2, H W] of pixel centres from its mean."""
    lines, columns = np.divmod(np.arange(height * width), width)
    dx, dy = columns + 0.5 - splats["means"][k][0], lines + 0.5 - splats["means"][k][1]
    a, b, c = splats["conics"][k]
    return np.exp(-(a * dx**2 + 2 * b * dx * dy + c * dy**2) / 2), np.array([dx, dy])
