"""PSNR and SSIM of a render against its photo."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from clsplat.errors import InputError

SSIM_WINDOW = 11  # pixels: skimage truncates a gaussian of sigma 1.5 at 3.5 sigma


def psnr(image: ArrayLike, photo: ArrayLike) -> float:
    """Peak signal-to-noise ratio, dB, over all pixels and channels; inf for equal images.

    Parameters
    ----------
    image, photo : float[H, W, 3], 0 to 1.
    """
    with np.errstate(divide="ignore"):
        return float(peak_signal_noise_ratio(_float64(photo), _float64(image), data_range=1.0))


def ssim(image: ArrayLike, photo: ArrayLike) -> float:
    """Structural similarity of Wang et al. (2004), -1 to 1: the mean of its map.

    The window is a gaussian of sigma 1.5, truncated to 11x11; K1 = 0.01, K2 = 0.03, population
    covariance, mean of the RGB channels. Pixels whose window would leave the image (a border of 5)
    do not count; the training loss and 3DGS's script pad with zeros instead.

    Parameters
    ----------
    image, photo : float[H, W, 3], 0 to 1.

    Raises
    ------
    InputError : the images are smaller than the window.
    """
    height, width = np.shape(image)[:2]
    if min(height, width) < SSIM_WINDOW:
        raise InputError(
            f"an image of {width}x{height} pixels is smaller than the {SSIM_WINDOW}x{SSIM_WINDOW} "
            "window of SSIM; use a smaller --downscale")
    return float(structural_similarity(
        _float64(image), _float64(photo), gaussian_weights=True, sigma=1.5,
        use_sample_covariance=False, data_range=1.0, channel_axis=-1))


def _float64(image: ArrayLike) -> NDArray[np.float64]:
    return np.asarray(image, np.float64)
