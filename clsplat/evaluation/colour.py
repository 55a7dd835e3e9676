"""Fit the colours of a render to its photo, so that exposure does not count as error."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

CHUNK_PIXELS = 1 << 16  # ten float64 features of a whole photo would not stay in cache


def fit_colour(image: ArrayLike, photo: ArrayLike, valid: NDArray[np.bool_] | None = None
               ) -> NDArray[np.float64]:
    """`image` under the quadratic colour map that brings it closest to `photo`.

    Each output channel is a weighted sum of the six products of two channels, the three channels
    and 1. The weights are the least-squares solution over all pixels, and the smallest one where
    the pixels do not determine it (a constant or grey image).

    Parameters
    ----------
    image, photo : float[H, W, 3], 0 to 1.
    valid : bool[H, W], the pixels that decide the map; None: all.

    Returns
    -------
    [H, W, 3], clipped to 0 to 1.
    """
    pixels = np.asarray(image, np.float64).reshape(-1, 3)
    target = np.asarray(photo, np.float64).reshape(-1, 3)
    kept = slice(None) if valid is None else np.flatnonzero(valid)
    fitting, target = pixels[kept], target[kept]
    gram, moment = np.zeros((10, 10)), np.zeros((10, 3))
    for begin in range(0, len(fitting), CHUNK_PIXELS):
        features = _features(fitting[begin:begin + CHUNK_PIXELS])
        gram += features.T @ features
        moment += features.T @ target[begin:begin + CHUNK_PIXELS]
    # the sums are accurate to about 1e-14 of the largest: smaller singular values are rounding
    weights = np.linalg.lstsq(gram, moment, rcond=1e-13)[0]
    fitted = np.empty_like(pixels)
    for begin in range(0, len(pixels), CHUNK_PIXELS):
        end = begin + CHUNK_PIXELS
        fitted[begin:end] = _features(pixels[begin:end]) @ weights
    return fitted.clip(0.0, 1.0).reshape(np.shape(image))


def _features(pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """[N, 10]: the features of colours [N, 3]."""
    r, g, b = pixels.T
    return np.stack([r * r, g * g, b * b, r * g, g * b, b * r, r, g, b, np.ones_like(r)], axis=1)
