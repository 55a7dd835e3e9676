"""(1 - w) L1 + w (1 - SSIM) of images [3, H, W], and its gradient (Wang et al. 2004 for SSIM)."""

import numpy as np

SIGMA = 1.5
RADIUS = 5
C1 = 0.01**2
C2 = 0.03**2


def image_loss(x, y, ssim_weight, valid=True):
    """loss, its gradient by x [3, H, W], mean |x - y|, mean SSIM.

    11-tap Gaussian window of sigma 1.5, zeros outside the image; means over pixels and channels.
    Pixels that are not valid [H, W] are as if outside: no window has its centre there; they have no
    difference and an SSIM of 1.
    """
    x, y = np.where(valid, x, 0), np.where(valid, y, 0)
    l1 = np.abs(x - y).mean()
    ssim, grad_ssim = mean_ssim(x, y, valid)
    loss = (1 - ssim_weight) * l1 + ssim_weight * (1 - ssim)
    grad = (1 - ssim_weight) * np.sign(x - y) / x.size - ssim_weight * grad_ssim
    return loss, grad, l1, ssim


def mean_ssim(x, y, valid=True):
    """Mean SSIM and its gradient by x."""
    mu_x, mu_y = window(x), window(y)
    contrast = window(x * x) + window(y * y) - mu_x**2 - mu_y**2
    structure = window(x * y) - mu_x * mu_y
    a1, a2 = 2 * mu_x * mu_y + C1, 2 * structure + C2
    b1, b2 = mu_x**2 + mu_y**2 + C1, contrast + C2
    ssim = a1 * a2 / (b1 * b2)

    by_contrast = -ssim / b2
    by_structure = 2 * a1 / (b1 * b2)
    by_mu = 2 * mu_y * a2 / (b1 * b2) - 2 * mu_x * ssim / b1
    by_mu -= 2 * mu_x * by_contrast + mu_y * by_structure
    ssim = np.where(valid, ssim, 1)
    by_mu, by_contrast, by_structure = (np.where(valid, by, 0) for by in (by_mu, by_contrast, by_structure))
    # the window is symmetric, so it is its own adjoint
    grad = window(by_mu) + 2 * x * window(by_contrast) + y * window(by_structure)
    return ssim.mean(), np.where(valid, grad, 0) / x.size


def window(image):
    """`image` [..., H, W] under the Gaussian window, zeros outside."""
    taps = np.exp(-(np.arange(-RADIUS, RADIUS + 1) ** 2) / (2 * SIGMA**2))
    taps /= taps.sum()
    for axis in (-2, -1):
        moved = np.moveaxis(image, axis, -1)
        padded = np.pad(moved, [(0, 0)] * (image.ndim - 1) + [(RADIUS, RADIUS)])
        size = moved.shape[-1]
        moved = sum(tap * padded[..., k : k + size] for k, tap in enumerate(taps))
        image = np.moveaxis(moved, -1, axis)
    return image
