"""Which views change without a block's gaussians (Liu et al. 2024, CityGaussian, section 3.2)."""

import math
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from clsplat.device import Array, Device
from clsplat.gaussians import Gaussians
from clsplat.io.models.values import to_bytes
from clsplat.loss.image_loss import image_loss, loss_value
from clsplat.rendering.pipeline import Renderer
from clsplat.rendering.project import Rows
from clsplat.scene import Scene

INVISIBLE = -1e4  # the logit of an opacity that is not drawn


class DropTest:
    """1 - SSIM between renders of a view with all gaussians and with some; see `partition.citygs`.

    It is that of the training loss. The device compares both renders with the full one in 8 bits,
    so what these lack is the same in both, and the difference of the two values is taken.

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
        latest, whole, itself = -1, None, 0.0
        for index, keep in tests:
            if latest != index:
                image = self._render(index, self.rows)
                whole = self.device.upload(to_bytes(255 * image.download()))
                latest, itself = index, _ssim(image, whole)
            logits = np.where(keep, self.logits, INVISIBLE).astype(self.logits.dtype)
            without = {**self.rows, "opacity_logits": self.device.upload(logits)}
            assert whole is not None
            yield itself - _ssim(self._render(index, without), whole)

    def _render(self, index: int, rows: Rows) -> Array:
        """real[3, H, W]: the image of a view."""
        camera = self.scene.views[index].camera
        return self.renderer.render(rows, self.renderer.pack(camera), camera.width, camera.height,
                                    self.degree).image


def _ssim(image: Array, photo: Array) -> float:
    """The mean SSIM of an image and a photo on the device."""
    partials, _ = image_loss(image.device, image, photo, 1.0)
    return loss_value(partials, math.prod(image.shape), 1.0)[2]
