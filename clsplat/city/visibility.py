"""Which views change without a block's gaussians (Liu et al. 2024, CityGaussian, section 3.2)."""

import os
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from clsplat.device import Device
from clsplat.evaluation.metrics import ssim
from clsplat.evaluation.views import Image, render_view
from clsplat.gaussians import Gaussians
from clsplat.io.ahead import called_ahead
from clsplat.rendering.pipeline import Renderer
from clsplat.scene import Scene

INVISIBLE = -1e4  # the logit of an opacity that is not drawn


class DropTest:
    """1 - SSIM between renders of a view with all gaussians and with some; see `partition.citygs`.

    Parameters
    ----------
    gaussians : in the frame of the scene.
    scene : at the size of the renders.
    """

    def __init__(self, device: Device, gaussians: Gaussians, scene: Scene) -> None:
        self.device, self.scene, self.logits = device, scene, gaussians.opacity_logits
        self.degree = gaussians.sh_degree
        self.renderer = Renderer(device, self.degree, scene.near_plane)
        self.rows = {name: device.upload(values) for name, values in gaussians.rows.items()}

    def __call__(self, tests: Iterable[tuple[int, NDArray[np.bool_]]]) -> Iterator[float]:
        """The change of each view without the gaussians where `keep` [N] is false.

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

        def change(without: Image, full: Image) -> float:
            return 1 - ssim(without, full)

        threads = os.cpu_count() or 1
        return called_ahead(change, rendered(), threads, threads)
