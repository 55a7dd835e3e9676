"""Scores by which gaussians are chosen to grow (Taming 3DGS, Mallick et al. 2024), and the blending
weights by which they stay."""

import math
from collections.abc import Callable, Iterable
from typing import Protocol

import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.constants import SPLAT_CONIC, SPLAT_CUTOFF, SPLAT_DEPTH, SPLAT_EXTENT_Y
from clsplat.device import Array, Device
from clsplat.loss.image_loss import image_loss, loss_value
from clsplat.rendering.contribution import contribution
from clsplat.rendering.pipeline import Frame, Renderer
from clsplat.rendering.project import Rows

LUMA = (0.299, 0.587, 0.114)  # ITU-R BT.601
MAP_WEIGHT = 50.0  # of each of the two maps of pixel weights
VIEW_WEIGHT = 50.0
MOST_WEIGHED = 400  # views by which it is counted how many pixels show a gaussian
COEFFICIENTS = {
    "gradient": 25.0,
    "opacity": 100.0,
    "depth": 5.0,
    "radius": 10.0,
    "volume": 25.0,
    "distance": 50.0,
    "weighted": 10.0,
    "pixels": 0.1,
    "weight": 50.0,
}


SizedCamera = tuple[Array, int, int]  # packed camera real[27], width and height, pixels


class ScoredView(Protocol):
    """A view that gaussians are scored in: packed camera real[27], photo uchar[3 or 4, H, W]."""

    camera: Array
    photo: Array


class Statistics:
    """Sums over the views since the last `clear`: lengths of screen gradients real[N], NDC units,
    and how many views saw a gaussian, uint[N] (cl/project.cl)."""

    def __init__(self, device: Device, count: int) -> None:
        self.device = device
        self.clear(count)

    def clear(self, count: int) -> None:
        """Start again for `count` gaussians."""
        self.grad_norm_sum = self.device.zeros(count)
        self.seen_count = self.device.zeros(count, np.uint32)

    @property
    def sums(self) -> tuple[Array, Array]:
        """Both arrays, for `Renderer.adjoint`, which adds a view."""
        return self.grad_norm_sum, self.seen_count

    def mean_gradient(self) -> NDArray[np.floating]:
        """float[N]: the mean screen gradient over the views that saw each gaussian; waits."""
        sums, counts = self.grad_norm_sum.download(), self.seen_count.download()
        means: NDArray[np.floating] = sums / np.maximum(counts, 1)
        return means


def taming_scores(
    renderer: Renderer,
    rows: Rows,
    views: Iterable[ScoredView],
    sh_degree: int,
    ssim_weight: float,
    gradient: NDArray[np.floating],
    shown: Callable[[Array], Rows] | None = None,
) -> NDArray[np.float64]:
    """The scores float64[N] of gaussians, summed over about ten views; 0 where no view sees one.

    A view's score is its loss times a sum of terms, each a value over the median of its positive
    values times a coefficient. Where the publication is not specific: medians are over the
    gaussians that the view sees; edges are the gradient magnitude of Sobel; a constant map has no
    weight; the distance from the mean is summed over the pixels. `gradient` is float[N], mean
    screen gradients; `ssim_weight` is the share of D-SSIM in the loss. `shown` returns all rows,
    with those harmonics that a packed camera sees; None: `rows` have them.
    """
    with np.errstate(over="ignore"):  # an infinity makes an opacity of 0, which is right
        opacity = 1 / (1 + np.exp(-rows["opacity_logits"].download().astype(np.float64)))
    volume = np.exp(rows["log_scales"].download().astype(np.float64).sum(axis=1))
    scores = np.zeros(len(gradient))
    for view in views:
        photo, (_, height, width) = view.photo, view.photo.shape
        frame = renderer.render(shown(view.camera) if shown else rows, view.camera, width, height, sh_degree)
        loss, visible, of_view = _seen(renderer.device, frame, photo, ssim_weight)
        values = {"gradient": gradient[visible], "opacity": opacity[visible], "volume": volume[visible], **of_view}
        scores[visible] += (
            VIEW_WEIGHT
            * loss
            * sum(coefficient * _by_median(values[name]) for name, coefficient in COEFFICIENTS.items())
        )
    return scores


def blending_weights(renderer: Renderer, rows: Rows, cameras: Iterable[SizedCamera]) -> NDArray[np.float64]:
    """float64[N], how many pixels show each gaussian: its weights alpha T in blending, summed over
    the pixels of the views of some cameras; of more than MOST_WEIGHED an estimate, by every n-th.
    """
    weights, cameras = np.zeros(len(rows["positions"])), list(cameras)
    chosen = cameras[:: -(-len(cameras) // MOST_WEIGHED)]
    for camera, width, height in chosen:
        frame = renderer.render(rows, camera, width, height, 0)  # colours have no weight
        nothing = renderer.device.zeros((height, width))  # no weighted sum is needed
        weights[frame.visible.download()] += contribution(renderer.device, frame, nothing).download()[:, 1]
        del frame, nothing
        renderer.device.trim()  # or blocks of the many sizes of frames add up
    return weights * (len(cameras) / max(1, len(chosen)))


def pixel_weights(image: NDArray[np.floating], photo: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Weights float64[H, W], 0 to 100, that are high where an image float[3, H, W] differs from its
    photo uint8[3 or 4, H, W], and where the photo has edges; 0 where a mask tells."""
    target = photo[:3] / 255
    error = np.abs(image - target).mean(axis=0)
    luma = np.tensordot(LUMA, target, 1)
    edges = np.hypot(scipy.ndimage.sobel(luma, axis=0), scipy.ndimage.sobel(luma, axis=1))
    valid: NDArray[np.bool_] = np.all(photo[3:], axis=0)
    return MAP_WEIGHT * (_spread(error * valid) + _spread(edges * valid)) * valid


def _seen(
    device: Device, frame: Frame, photo: Array, ssim_weight: float
) -> tuple[float, NDArray[np.uint32], dict[str, NDArray[np.float64]]]:
    """A frame's loss, its visible rows uint[V], and the terms float64[V] of this view."""
    partials, _ = image_loss(device, frame.exposed, photo, ssim_weight)
    loss, _, _ = loss_value(partials, math.prod(frame.image.shape), ssim_weight)
    weights = device.upload(pixel_weights(frame.exposed.download(), photo.download()))
    pixels, weight, weighted, distance = contribution(device, frame, weights).download().T.astype(np.float64)
    splats = frame.splats.download().astype(np.float64)
    return (
        loss,
        frame.visible.download(),
        {
            "depth": splats[:, SPLAT_DEPTH],
            "radius": _radius(splats),
            "distance": distance,
            "weighted": weighted,
            "pixels": pixels,
            "weight": weight,
        },
    )


def _radius(splats: NDArray[np.float64]) -> NDArray[np.float64]:
    """float64[V], pixels: the standard deviation along the longer axis of splats [V, 12]
    (cl/include/splat.h). It uses the extent, since inverting a needle's conic loses all digits."""
    cutoff, extent_y = splats[:, SPLAT_CUTOFF], splats[:, SPLAT_EXTENT_Y]
    a, b, c = splats[:, SPLAT_CONIC : SPLAT_CONIC + 3].T
    yy = extent_y**2 / cutoff
    xx, xy = yy * c / a, -yy * b / a
    radius: NDArray[np.float64] = np.sqrt((xx + yy) / 2 + np.hypot((xx - yy) / 2, xy))
    return radius


def _by_median(values: NDArray[np.floating]) -> NDArray[np.floating]:
    positive = values[values > 0]
    return values / np.median(positive) if len(positive) else values


def _spread(values: NDArray[np.floating]) -> NDArray[np.floating]:
    """Values scaled to 0 to 1; all 0 if they are all the same."""
    low, high = values.min(), values.max()
    return (values - low) / (high - low) if high > low else np.zeros_like(values)
