"""Which views change without a block's gaussians (Liu et al. 2024, CityGaussian, section 3.2)."""

import numpy as np
from numpy.typing import NDArray

from clsplat.device import Device
from clsplat.evaluation.metrics import ssim
from clsplat.evaluation.views import Image, render_view
from clsplat.gaussians import Gaussians
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
        self._index = -1  # of the latest view, whose full render is kept
        self._full: Image = np.empty((0, 0, 3))

    def __call__(self, index: int, keep: NDArray[np.bool_]) -> float:
        """The change of view `index` without the gaussians where `keep` [N] is false."""
        camera = self.scene.views[index].camera
        if self._index != index:
            self._index = index
            self._full = render_view(self.renderer, self.rows, self.degree, camera)
        logits = np.where(keep, self.logits, INVISIBLE).astype(self.logits.dtype)
        rows = {**self.rows, "opacity_logits": self.device.upload(logits)}
        return 1 - ssim(render_view(self.renderer, rows, self.degree, camera), self._full)
