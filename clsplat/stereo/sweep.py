"""Depth of a photo's pixels, by comparing it with other photos on planes, and which photos confirm
it (cl/sweep.cl)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.device import Array, Device, Kernel, items

SWEEP = Kernel(
    "sweep.cl",
    "sweep",
    items("width height", "SCAN_GROUP"),
    width="int",
    height="int",
    reference="int",
    source_count="int",
    planes="int",
    first="real",
    spacing="real",
    images=("real", "V", "H", "W", 2),
    sizes=("int", "V", 2),
    sources=("int", "S"),
    warps=("real", "S", 12),
    inverse_depths=("real", "H", "W"),
    scores=("real", "H", "W"),
)
CONFIRM = Kernel(
    "sweep.cl",
    "confirm",
    items("width height", "SCAN_GROUP"),
    width="int",
    height="int",
    reference="int",
    source_count="int",
    same_depth="real",
    images=("real", "V", "H", "W", 2),
    sizes=("int", "V", 2),
    sources=("int", "S"),
    warps=("real", "S", 12),
    confirmed=("uint", "H", "W"),
)


class Compared(NamedTuple):
    """A photo and those with which it is compared, on the device."""

    # images, sizes: `device_images` of some photos, or of the inverse depths of their pixels
    images: Array
    sizes: Array
    reference: int  # index of the photo
    sources: Array  # int[S], those of the others
    warps: Array  # real[S, 12], `plane_warp` of each

    @classmethod
    def of(
        cls, images: Array, sizes: Array, cameras: Sequence[Camera], reference: int, sources: Sequence[int]
    ) -> Compared:
        """The photo `reference` with `sources`; `cameras` are those of all photos."""
        warps = [plane_warp(cameras[reference], cameras[source]) for source in sources]
        upload = images.device.upload
        return cls(images, sizes, reference, upload(np.array(sources, np.int32)), upload(np.array(warps)))


def sweep(compared: Compared, inverse_depths: tuple[float, float], planes: int) -> tuple[Array, Array]:
    """The inverse depth of each pixel of a reference, real[H, W], 1 / world unit, and how alike its
    window looks in at least two sources, real[H, W], from -1 to 1; 0 where there is none.

    Images are grey, 0 to 1, nan where a pixel does not count; `inverse_depths` are those of the
    first and the last of at least three `planes`.
    """
    device, (_, height, width, _) = compared.images.device, compared.images.shape
    first, last = inverse_depths
    found = device.empty((height, width)), device.empty((height, width))
    device.launch(
        SWEEP,
        width=width,
        height=height,
        source_count=len(compared.sources),
        planes=planes,
        first=first,
        spacing=(last - first) / (planes - 1),
        **compared._asdict(),
        inverse_depths=found[0],
        scores=found[1],
    )
    return found


def confirm(compared: Compared, same_depth: float) -> Array:
    """How many sources have the depth of a pixel of the reference where it projects to, uint[H, W].

    Images are the inverse depths of pixels, 1 / world unit, 0 where there is none; depths are the
    same whose relative difference is below `same_depth`.
    """
    device, (_, height, width, _) = compared.images.device, compared.images.shape
    confirmed = device.empty((height, width), np.uint32)
    device.launch(
        CONFIRM,
        width=width,
        height=height,
        source_count=len(compared.sources),
        same_depth=same_depth,
        **compared._asdict(),
        confirmed=confirmed,
    )
    return confirmed


def plane_warp(reference: Camera, source: Camera, first_centre: float = 0.5) -> NDArray[np.float64]:
    """float64[12]: A [3, 3] by rows and b [3], with which the reference's pixel (x, y) at inverse
    depth w lies at A (x, y, 1) + w b in the source, homogeneous (Gallup et al. 2007, eq. 1). The
    centre of the first pixel has the coordinates `first_centre`."""
    turn = source.rotation @ reference.rotation.T
    shift = source.translation - turn @ reference.translation
    matrix = _intrinsics(source, first_centre)
    return np.concatenate(
        [(matrix @ turn @ np.linalg.inv(_intrinsics(reference, first_centre))).ravel(), matrix @ shift]
    )


def _intrinsics(camera: Camera, first_centre: float) -> NDArray[np.float64]:
    (fx, fy), (cx, cy) = camera.focal, np.subtract(camera.centre, 0.5 - first_centre)
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def device_images(device: Device, photos: Sequence[NDArray[np.floating]]) -> tuple[Array, Array]:
    """Photos [h, w] of any sizes on the device: real[V, H, W, 2], each pixel with the one to its
    right, and the sizes int[V, 2] (width, height)."""
    sizes = np.array([photo.shape[::-1] for photo in photos], np.int32)
    width, height = sizes.max(axis=0)
    images = np.full((len(photos), height, width, 2), np.nan, device.real)
    for image, photo, (w, h) in zip(images, photos, sizes):
        image[:h, :w, 0], image[:h, : w - 1, 1] = photo, photo[:, 1:]
    return device.upload(images), device.upload(sizes)
