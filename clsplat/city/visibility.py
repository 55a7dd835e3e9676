"""Which views change without a block's gaussians (Liu et al. 2024, CityGaussian, section 3.2)."""

import numpy as np

from clsplat.evaluation.metrics import ssim
from clsplat.evaluation.views import render_view
from clsplat.rendering.pipeline import Renderer

GONE = -1e4  # a logit: of an opacity that is not drawn


class DropTest:
    """1 - SSIM between a view of all gaussians and one of some; see `partition.citygs`.

    scene: Scene at the size to look at; gaussians: in its frame.
    """

    def __init__(self, device, gaussians, scene):
        self.device, self.scene, self.logits = device, scene, gaussians.opacity_logits
        self.degree = gaussians.sh_degree
        self.renderer = Renderer(device, self.degree, scene.near_plane)
        self.rows = {name: device.upload(values) for name, values in gaussians.rows.items()}
        self._latest = None, None  # index of a view, its full render

    def __call__(self, index, keep):
        """float: of the view `index` without gaussians where `keep` bool[N] is false."""
        camera = self.scene.views[index].camera
        if self._latest[0] != index:
            self._latest = index, render_view(self.renderer, self.rows, self.degree, camera)
        logits = np.where(keep, self.logits, GONE).astype(self.logits.dtype)
        rows = {**self.rows, "opacity_logits": self.device.upload(logits)}
        return 1 - ssim(render_view(self.renderer, rows, self.degree, camera), self._latest[1])
