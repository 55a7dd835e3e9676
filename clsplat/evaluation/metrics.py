"""PSNR and SSIM of a render against its photo, or against the part of it that a mask leaves."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import minimum_filter
from skimage.metrics import structural_similarity

from clsplat.errors import InputError

SSIM_WINDOW = 11  # pixels: skimage truncates a gaussian of sigma 1.5 at 3.5 sigma


def psnr(image: ArrayLike, photo: ArrayLike, valid: NDArray[np.bool_] | None = None) -> float:
    """Peak signal-to-noise ratio, dB, over all pixels and channels; inf for equal images.

    Parameters
    ----------
    image, photo : float[H, W, 3], 0 to 1.
    valid : bool[H, W], the pixels that count, at least one; None: all.
    """
    errors = _float64(photo) - _float64(image)
    if valid is not None:
        errors = errors[valid]
    # skimage's function of this would import scipy.stats, a third of what every command waits for
    with np.errstate(divide="ignore"):
        return float(-10 * np.log10(np.mean(errors**2)))


def ssim(image: ArrayLike, photo: ArrayLike, valid: NDArray[np.bool_] | None = None) -> float:
    """Structural similarity of Wang et al. (2004), -1 to 1: the mean of its map.

    The window is a gaussian of sigma 1.5, truncated to 11x11; K1 = 0.01, K2 = 0.03, population
    covariance, mean of the RGB channels. Pixels whose window would leave the image (a border of 5)
    do not count; the training loss and 3DGS's script pad with zeros instead. With a mask, only
    pixels do whose whole window counts, or where there are none, all that count themselves.

    Parameters
    ----------
    image, photo : float[H, W, 3], 0 to 1.
    valid : bool[H, W], the pixels that count, at least one; None: all.

    Raises
    ------
    InputError : the images are smaller than the window.
    """
    height, width = np.shape(image)[:2]
    if min(height, width) < SSIM_WINDOW:
        raise InputError(
            f"an image of {width}x{height} pixels is smaller than the {SSIM_WINDOW}x{SSIM_WINDOW} "
            "window of SSIM; use larger photos, by a smaller --downscale or a larger "
            "--max-resolution")
    mean, of_pixels = structural_similarity(
        _float64(image), _float64(photo), gaussian_weights=True, sigma=1.5,
        use_sample_covariance=False, data_range=1.0, channel_axis=-1, full=True)
    if valid is None:
        return float(mean)
    whole = minimum_filter(valid, SSIM_WINDOW, mode="constant", cval=0)
    return float(of_pixels[whole if whole.any() else valid].mean())


def _float64(image: ArrayLike) -> NDArray[np.float64]:
    return np.asarray(image, np.float64)
