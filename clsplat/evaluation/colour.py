"""Fit the colours of a render to its photo, so that exposure does not count as error."""

import numpy as np

CHUNK = 1 << 16  # pixels at once: ten float64 features of a whole photo would not stay in cache


def fit_colour(image, photo):
    """`image` under the quadratic colour map that brings it closest to `photo`.

    image, photo: float[H, W, 3], 0 to 1. Returns float64[H, W, 3], clipped to 0..1. Each output
    channel is a weighted sum of the six products of two channels, the three channels and 1; the
    weights are the least-squares ones over all pixels. Where pixels do not determine them (a
    constant or grey image) the smallest weights are taken.
    """
    pixels = np.asarray(image, np.float64).reshape(-1, 3)
    target = np.asarray(photo, np.float64).reshape(-1, 3)
    gram, moment = np.zeros((10, 10)), np.zeros((10, 3))
    for begin in range(0, len(pixels), CHUNK):
        features = _features(pixels[begin:begin + CHUNK])
        gram += features.T @ features
        moment += features.T @ target[begin:begin + CHUNK]
    # the sums are good to about 1e-14 of the largest: smaller singular values are rounding
    weights = np.linalg.lstsq(gram, moment, rcond=1e-13)[0]
    fitted = np.empty_like(pixels)
    for begin in range(0, len(pixels), CHUNK):
        fitted[begin:begin + CHUNK] = _features(pixels[begin:begin + CHUNK]) @ weights
    return fitted.clip(0.0, 1.0).reshape(np.shape(image))


def _features(pixels):
    """float64[N, 10] of colours float64[N, 3]."""
    r, g, b = pixels.T
    return np.stack([r * r, g * g, b * b, r * g, g * b, b * r, r, g, b, np.ones_like(r)], axis=1)
