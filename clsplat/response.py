"""What a camera makes of the colours of a scene: vignetting, exposure and white balance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.constants import VIGNETTING_REALS, VIGNETTING_TERMS

SAME_FOCAL = 0.05  # relative: the photos of one lens may have been calibrated one by one


def no_vignetting() -> NDArray[np.float64]:
    """The vignetting of a lens that has none."""
    return np.append(np.zeros(VIGNETTING_TERMS), 1.0)


@dataclass(frozen=True, eq=False)
class Response:
    """The response of a photo: c' = M (g c) + t, with the gain g of a pixel.

    The gain of a lens is g = 1 + a u + b u^2 + c u^3, where u = s ((x - cx)^2 / fx^2 +
    (y - cy)^2 / fy^2) is 0 on the optical axis. It is a factor of the
    light; a tone curve that is a power makes another factor of it, so it may be applied to display
    values.

    Attributes
    ----------
    transform : float64[3, 4], rows [M | t].
    vignetting : float64[4], (a, b, c, s); s is such that u is 1 in the farthest corner of a photo.
    """

    transform: NDArray[np.float64] = field(default_factory=lambda: np.eye(3, 4))
    vignetting: NDArray[np.float64] = field(default_factory=no_vignetting)

    @property
    def has_vignetting(self) -> bool:
        """Whether the gain is other than 1 anywhere."""
        return bool(self.vignetting[:VIGNETTING_TERMS].any())

    def gain(self, camera: Camera) -> NDArray[np.float64]:
        """float64[H, W], the gain of the pixels of a camera's image."""
        *factors, scale = self.vignetting.tolist()
        u, gain = scale * squared_radius(camera), np.zeros((camera.height, camera.width))
        for factor in reversed(factors):
            gain = (gain + factor) * u
        return 1 + gain

    def applied(self, image: NDArray[np.floating], camera: Camera) -> NDArray[np.float32]:
        """The photo [H, W, 3] that the camera makes of the colours [H, W, 3] of a scene."""
        if self.has_vignetting:
            image = image * self.gain(camera)[:, :, None]
        # plane by plane, as devices make images: a quarter of the time of a product for each pixel
        photo: NDArray[np.float64] = np.einsum("ij,hwj->ihw", self.transform[:, :3], image)
        photo += self.transform[:, 3, None, None]
        return photo.astype(np.float32).transpose(1, 2, 0)


def squared_radius(camera: Camera) -> NDArray[np.float64]:
    """float64[H, W], the squared distance of the pixels from the optical axis, in focal lengths."""
    x = (np.arange(camera.width) + 0.5 - camera.centre[0]) / camera.focal[0]
    y = (np.arange(camera.height) + 0.5 - camera.centre[1]) / camera.focal[1]
    return x**2 + y[:, None] ** 2


def corner_radius(camera: Camera) -> float:
    """The squared distance of the farthest corner of the whole photo, in focal lengths."""
    left, top, right, bottom = camera.borders
    x = max(abs(left - camera.centre[0]), abs(right - camera.centre[0])) / camera.focal[0]
    y = max(abs(top - camera.centre[1]), abs(bottom - camera.centre[1])) / camera.focal[1]
    return x**2 + y**2


@dataclass(frozen=True, eq=False)
class Lenses:
    """The lenses of views.

    Attributes
    ----------
    of : int[V], the lens of each view.
    rows : float64[L, 4], the vignetting of each lens.
    """

    of: NDArray[np.int64]
    rows: NDArray[np.float64]

    @classmethod
    def of_cameras(cls, cameras: Sequence[Camera]) -> Lenses:
        """Lenses that change nothing, one for all photos of one shape and one focal length.

        Parameters
        ----------
        cameras : of the views.
        """
        kinds = [lens_kind(camera) for camera in cameras]
        known = {kind: number for number, kind in enumerate(dict.fromkeys(kinds))}
        of = np.array([known[kind] for kind in kinds])
        rows = np.zeros((len(known), VIGNETTING_REALS))
        for lens, camera in zip(of, cameras):
            rows[lens, -1] = max(rows[lens, -1], corner_radius(camera))
        rows[:, -1] = 1 / rows[:, -1]
        return cls(of, rows)

    @classmethod
    def of_responses(cls, responses: Sequence[Response]) -> Lenses:
        """A lens for each response that is known already."""
        return cls(np.arange(len(responses)), np.array([response.vignetting for response in responses]))


def lens_kind(camera: Camera) -> tuple[int, int]:
    """The same for all cameras with one lens."""
    left, top, right, bottom = camera.borders
    width, height = right - left, bottom - top
    return (round(np.log(width / height) / SAME_FOCAL), round(np.log(camera.focal[0] / width) / SAME_FOCAL))
