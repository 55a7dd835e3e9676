"""The depth maps of training views on the device."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from clsplat.device import Array, ArraySpec, Device
from clsplat.io.photos.depth import read_depth
from clsplat.io.photos.views import read_valid
from clsplat.scene import View

DEVICE_SHARE = 0.125  # of the device's memory that depth maps may take


def depth_array(view: View) -> ArraySpec | None:
    """The device array of a view's depth map; None without one."""
    return ArraySpec((view.camera.height, view.camera.width)) if view.depth else None


class DepthMapsOnDevice:
    """`maps[i]` is view i's depth map at the present level, real[H, W]; None without one.

    Depths are along the camera's axis in units of the scene, and 0 where there is none or the
    photo's pixel does not count. Maps of a level stay on the device if all fit; else each is read
    at each use.

    Parameters
    ----------
    device : of the training.
    unit : original world units in a unit of the scene.
    """

    def __init__(self, device: Device, unit: float) -> None:
        self.device, self.unit = device, unit

    def use(self, views: Sequence[View]) -> None:
        """Use the maps of views with cameras of a level from now on."""
        self._views = views
        needed = sum(spec.nbytes(self.device.real) for spec in map(depth_array, views) if spec)
        self._kept: list[Array | None] | None = None
        if needed <= DEVICE_SHARE * self.device.handle.global_mem_size:
            self._kept = [self._upload(view) for view in views]

    def __getitem__(self, index: int) -> Array | None:
        return self._kept[index] if self._kept else self._upload(self._views[index])

    def _upload(self, view: View) -> Array | None:
        if view.depth is None:
            return None
        depth: NDArray[np.float32] = read_depth(view) / np.float32(self.unit)
        valid = read_valid(view)
        if valid is not None:
            depth[~valid] = 0
        return self.device.upload(depth)
