"""A volume of signed distances from the surface that views show (cl/signed_distance.cl)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.constants import BRICK_SIDE, CAMERA_REALS
from clsplat.device import Array, Device, Kernel, items
from clsplat.rendering.project import pack_camera

SUMS = 7  # of a sample
_PLANE = ("real", "H", "W")
SIGNED_DISTANCE = Kernel(
    "signed_distance.cl",
    "signed_distance",
    items("C BRICK_SIDE BRICK_SIDE BRICK_SIDE", "SCAN_GROUP"),
    count="uint",
    chosen_count="uint",
    width="int",
    height="int",
    voxel="real",
    truncation="real",
    bricks=("int", "B", 3),
    chosen=("uint", "C"),
    camera=("real", CAMERA_REALS),
    depth=_PLANE,
    first=_PLANE,
    transmittance=_PLANE,
    image=("real", 3, "H", "W"),
    sums=("real", SUMS, "B", BRICK_SIDE**3),
)


def brick_bytes(device: Device) -> int:
    """The device memory that a brick of a volume takes."""
    return SUMS * BRICK_SIDE**3 * device.real.itemsize


class Volume:
    """Bricks of samples of the signed distance, on the device.

    Parameters
    ----------
    device : an open device.
    bricks : int[B, 3], their places, in units of BRICK_CELLS voxels from the origin.
    voxel : between neighbouring samples, world units.
    truncation : the distance beyond which all distances are the same, world units.
    """

    def __init__(self, device: Device, bricks: NDArray[np.integer], voxel: float, truncation: float) -> None:
        self._device, self._voxel, self._truncation = device, voxel, truncation
        self._bricks = device.upload(np.asarray(bricks, np.int32))
        self._sums = device.zeros((SUMS, len(bricks), BRICK_SIDE**3))

    def add(
        self,
        chosen: NDArray[np.integer],
        camera: Camera,
        near: float,
        depth: Array,
        first: Array,
        transmittance: Array,
        image: Array,
    ) -> None:
        """Add what a view shows.

        Parameters
        ----------
        chosen : int[C], the bricks that it may see, each once.
        camera, near : a pinhole camera, and the depth of its near plane, world units.
        depth, first : real[H, W], where half of the light is held back, and where less of it is,
            along the camera's axis, world units; an image with a side of one pixel shows nothing.
        transmittance : real[H, W].
        image : real[3, H, W].
        """
        height, width = depth.shape
        if len(chosen) and min(width, height) > 1:
            self._device.launch(
                SIGNED_DISTANCE,
                count=len(self._bricks),
                chosen_count=len(chosen),
                width=width,
                height=height,
                voxel=self._voxel,
                truncation=self._truncation,
                bricks=self._bricks,
                chosen=self._device.upload(np.asarray(chosen, np.uint32)),
                camera=pack_camera(self._device, camera, near),
                depth=depth,
                first=first,
                transmittance=transmittance,
                image=image,
                sums=self._sums,
            )

    def download(self) -> NDArray[np.floating]:
        """real[SUMS, B, BRICK_SIDE, BRICK_SIDE, BRICK_SIDE], see cl/signed_distance.cl."""
        return self._sums.download().reshape(SUMS, -1, *3 * [BRICK_SIDE])
