"""Depth maps of the photos, which hold the training."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsplat.device import Array, ArraySpec, Device
from clsplat.io.photos.depth import read_depth
from clsplat.io.photos.views import read_valid
from clsplat.loss.depth_map import compare_depth
from clsplat.loss.options import DepthOptions
from clsplat.scene import View
from clsplat.training.part import Inputs, Now, Part, TrainingSample, ViewPass

if TYPE_CHECKING:
    from clsplat.training.session import Session
    from clsplat.training.start.prepare import PreparedScene

DEVICE_SHARE = 0.125  # of the device's memory that depth maps may take


def depth_array(view: View) -> ArraySpec | None:
    """The device array of a view's depth map; None without one."""
    return ArraySpec((view.camera.height, view.camera.width)) if view.depth else None


class DepthMaps(Part):
    """The difference between the rendered depth and the depth map of a view that has one.

    Maps of a level stay on the device if all fit; else each is read at each use.
    """

    name = "depth"
    Options = DepthOptions
    needs_depth = True

    def __init__(self, weight: float = DepthOptions.depth_weight) -> None:
        self.weight = weight

    @classmethod
    def is_used(cls, prepared: PreparedScene) -> bool:
        return bool(prepared.options.depth and prepared.options.depth_weight)

    def begin(self, session: Session) -> None:
        self.weight = session.options.depth_weight

    def begin_level(self, session: Session) -> None:
        self.use(session.device, session.photos.views, session.scene.unit)

    def use(self, device: Device, views: Sequence[View], unit: float) -> None:
        """Use the maps of these views; `unit` is the world units in a unit of the scene."""
        self._device, self._views, self._unit = device, views, unit
        needed = sum(spec.nbytes(device.real) for spec in map(depth_array, views) if spec)
        self.resident = needed <= DEVICE_SHARE * device.memory_limit
        self._kept = [self._upload(view) for view in views] if self.resident else []

    def map_of(self, view: int) -> Array | None:
        """A view's depth map, real[H, W], along the camera's axis in units of the scene, 0 where no
        depth is known or the photo's pixel does not count; None without one."""
        return self._kept[view] if self.resident else self._upload(self._views[view])

    def _upload(self, view: View) -> Array | None:
        if view.depth is None:
            return None
        depth: NDArray[np.float32] = read_depth(view) / np.float32(self._unit)
        valid = read_valid(view)
        if valid is not None:
            depth[~valid] = 0
        return self._device.upload(depth)

    def inputs(self, now: Now, sample: TrainingSample) -> Inputs | None:
        known = self.map_of(sample.view)
        return None if known is None else {"map": known}

    def add_to(self, work: ViewPass, inputs: Inputs) -> Array:
        blended = work.frame.blended
        sums, grad_depth, grad_transmittance = compare_depth(
            work.counts.device, blended.depth, blended.transmittance, inputs["map"], self.weight
        )
        work.grad.add(depth=grad_depth, transmittance=grad_transmittance)
        return sums

    def values(self, measured: list[Array]) -> dict[str, float]:
        """The mean relative error of the depth, over the pixels that count."""
        errors = np.array([sums.download() for sums in measured], np.float64)
        return {"depth_error": float(errors[:, 0].sum() / max(errors[:, 1].sum(), 1))}
