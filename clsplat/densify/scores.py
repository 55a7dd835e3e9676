"""How much each gaussian deserves to grow (Taming 3DGS, Mallick et al. 2024)."""

import numpy as np
from scipy.ndimage import sobel

from clsplat.constants import SPLAT_CONIC, SPLAT_CUTOFF, SPLAT_DEPTH, SPLAT_EXTENT_Y
from clsplat.densify.contribution import contribution
from clsplat.loss.image_loss import image_loss, loss_value

GREY = (0.299, 0.587, 0.114)  # ITU-R BT.601
MAP_WEIGHT = 50.0  # of each of the maps that weigh pixels
VIEW_WEIGHT = 50.0
COEFFICIENTS = {
    "gradient": 25.0, "opacity": 100.0, "depth": 5.0, "radius": 10.0, "volume": 25.0,
    "distance": 50.0, "weighted": 10.0, "pixels": 0.1, "weight": 50.0}


def taming_scores(renderer, rows, views, degree, ssim_weight, gradient):
    """float64[N] on the host: the scores, summed over views; 0 for gaussians that none sees.

    rows: field name -> real[N, ...] on the device; views: some ten (packed camera, photo
    uchar[3, H, W] on the device); gradient: float[N], mean screen gradient. A view's score is its
    loss times the sum of terms, each a value over the median of its positive values times a
    coefficient.

    Where the publication leaves room: medians are over the gaussians that the view sees; edges are
    the gradient magnitude of Sobel; a map that is the same everywhere weighs nothing; the distance
    from the mean is summed over the pixels.
    """
    with np.errstate(over="ignore"):  # an infinity makes an opacity of 0, which is right
        opacity = 1 / (1 + np.exp(-rows["opacity_logits"].download().astype(np.float64)))
    volume = np.exp(rows["log_scales"].download().astype(np.float64).sum(axis=1))
    scores = np.zeros(len(gradient))
    for camera, photo in views:
        _, height, width = photo.shape
        frame = renderer.render(rows, camera, width, height, degree)
        loss, visible, of_view = _seen(renderer.device, frame, photo, ssim_weight)
        values = {"gradient": gradient[visible], "opacity": opacity[visible],
                  "volume": volume[visible], **of_view}
        scores[visible] += VIEW_WEIGHT * loss * sum(
            coefficient * _by_median(values[name]) for name, coefficient in COEFFICIENTS.items())
    return scores


def pixel_weights(image, photo):
    """float64[H, W], 0 to 100: where an image float[3, H, W] is far from its photo uint8[3, H, W],
    and where the photo has edges."""
    photo = photo / 255
    error = np.abs(image - photo).mean(axis=0)
    grey = np.tensordot(GREY, photo, 1)
    edges = np.hypot(sobel(grey, axis=0), sobel(grey, axis=1))
    return MAP_WEIGHT * (_spread(error) + _spread(edges))


def _seen(device, frame, photo, ssim_weight):
    """A frame's loss, its visible rows uint[V], and the terms float64[V] that the view decides."""
    sums, _ = image_loss(device, frame.image, photo, ssim_weight)
    loss, _, _ = loss_value(sums, np.prod(photo.shape), ssim_weight)
    weights = device.upload(pixel_weights(frame.image.download(), photo.download()))
    pixels, weight, weighted, distance = contribution(device, frame, weights).download().T.astype(
        np.float64)
    splats = frame.splats.download().astype(np.float64)
    return loss, frame.visible.download(), {
        "depth": splats[:, SPLAT_DEPTH], "radius": _radius(splats), "distance": distance,
        "weighted": weighted, "pixels": pixels, "weight": weight}


def _radius(splats):
    """float64[V], pixels: the standard deviation along the longer axis, of splats[V, 12]
    (cl/include/splat.h). From the extent: the inverse of a needle's conic has no digits left."""
    cutoff, extent_y = splats[:, SPLAT_CUTOFF], splats[:, SPLAT_EXTENT_Y]
    a, b, c = splats[:, SPLAT_CONIC:SPLAT_CONIC + 3].T
    yy = extent_y**2 / cutoff
    xx, xy = yy * c / a, -yy * b / a
    return np.sqrt((xx + yy) / 2 + np.hypot((xx - yy) / 2, xy))


def _by_median(values):
    positive = values[values > 0]
    return values / np.median(positive) if len(positive) else values


def _spread(values):
    """`values` from 0 to 1; all 0 where they are all the same."""
    low, high = values.min(), values.max()
    return (values - low) / (high - low) if high > low else np.zeros_like(values)
