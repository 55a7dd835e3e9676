"""Which views change without a block's gaussians (Liu et al. 2024, CityGaussian, section 3.2)."""

import os
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from clsplat.device import Device
from clsplat.evaluation.metrics import SSIM_WINDOW, ssim
from clsplat.evaluation.views import Image, render_view
from clsplat.gaussians import Gaussians
from clsplat.io.ahead import called_ahead
from clsplat.rendering.pipeline import Renderer
from clsplat.scene import Scene

INVISIBLE = -1e4  # the logit of an opacity that is not drawn
ROWS_SHARE = 8  # one of so many parts of an image's rows is compared first


class DropTest:
    """1 - SSIM between renders of a view with all gaussians and with some; see `partition.citygs`.

    Parameters
    ----------
    gaussians : in the frame of the scene.
    scene : at the size of the renders.
    threshold : changes above it need not be known exactly.
    """

    def __init__(self, device: Device, gaussians: Gaussians, scene: Scene, threshold: float
                 ) -> None:
        self.device, self.scene, self.logits = device, scene, gaussians.opacity_logits
        self.threshold = threshold
        self.degree = gaussians.sh_degree
        self.renderer = Renderer(device, self.degree, scene.near_plane)
        self.rows = {name: device.upload(values) for name, values in gaussians.rows.items()}

    def __call__(self, tests: Iterable[tuple[int, NDArray[np.bool_]]]) -> Iterator[float]:
        """The change of each view without the gaussians where `keep` [N] is false, or a lower bound
        of it above the threshold.

        Parameters
        ----------
        tests : (the index of a view, keep), all of a view in turn, as it is rendered once in full.
        """
        def rendered() -> Iterator[tuple[Image, Image]]:
            latest = -1
            full: Image = np.empty((0, 0, 3))
            for index, keep in tests:
                camera = self.scene.views[index].camera
                if latest != index:
                    latest = index
                    full = render_view(self.renderer, self.rows, self.degree, camera)
                logits = np.where(keep, self.logits, INVISIBLE).astype(self.logits.dtype)
                rows = {**self.rows, "opacity_logits": self.device.upload(logits)}
                yield render_view(self.renderer, rows, self.degree, camera), full

        def changed(without: Image, full: Image) -> float:
            return change(without, full, self.threshold)

        threads = os.cpu_count() or 1
        return called_ahead(changed, rendered(), threads, threads)


def change(image: Image, other: Image, threshold: float) -> float:
    """1 - SSIM of two images, or where that is above a threshold, perhaps a lower bound above it.

    1 - SSIM is 0 where a window sees no difference, and nowhere negative. So only the rows and
    columns that differ count, and the sum over those rows that differ most is a lower bound; most
    views change by far more than the threshold.

    Parameters
    ----------
    image, other : [H, W, 3].
    """
    differences = np.abs(image - other).sum(axis=2)
    if not differences.any():
        return 0.0
    part = tuple(_reached(differences.any(axis=axis)) for axis in (1, 0))
    whole, differences = _windows(image), differences[part]
    image, other = image[part], other[part]
    rows = max(2 * SSIM_WINDOW, len(image) // ROWS_SHARE)
    if rows < len(image):
        first = int(np.argmax(np.convolve(differences.sum(axis=1), np.ones(rows), "valid")))
        most = slice(first, first + rows)
        least = (1 - ssim(image[most], other[most])) * _windows(image[most]) / whole
        if least > threshold:
            return least
    return (1 - ssim(image, other)) * _windows(image) / whole


def _reached(differs: NDArray[np.bool_]) -> slice:
    """The rows or columns that are in a window with one that differs, [N]."""
    places = np.flatnonzero(differs)
    reach = SSIM_WINDOW - 1
    return slice(max(0, int(places[0]) - reach), int(places[-1]) + reach + 1)


def _windows(image: Image) -> int:
    """How many windows lie in an image."""
    height, width = image.shape[:2]
    return int((height - SSIM_WINDOW + 1) * (width - SSIM_WINDOW + 1))
