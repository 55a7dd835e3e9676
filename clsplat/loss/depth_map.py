"""The rendered depth of a view against a depth map (cl/depth_map.cl), which holds the training."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from clsplat.device import Array, ArraySpec, Device, Forms, Kernel, groups, items
from clsplat.loss.term import FrameGradient, LossTerm, TrainingSample
from clsplat.primitives.reduce import sum_columns
from clsplat.rendering.frame_arrays import FrameArray
from clsplat.rendering.pipeline import Frame

if TYPE_CHECKING:
    from clsplat.options import TrainOptions

_PLANE = ("real", "H", "W")
COMPARE = Kernel(
    "depth_map.cl", "compare_depth", Forms(item=items("H"), group=groups("H", "SCAN_GROUP")),
    width="int", height="int", weight="real", depth=_PLANE, transmittance=_PLANE, map=_PLANE,
    grad_depth=_PLANE, grad_transmittance=_PLANE, partials=("real", "H", 2))


def compare_depth(device: Device, depth: Array, transmittance: Array, known: Array, weight: float
                  ) -> tuple[Array, Array, Array]:
    """The difference of a rendered view's depth from a depth map, and its gradients.

    Parameters
    ----------
    device : the device of the arrays.
    depth, transmittance : real[H, W], rendered.
    known : real[H, W], depths along the camera's axis, world units; 0: unknown.
    weight : of the loss.

    Returns
    -------
    real[2], the sum of the relative errors and the number of pixels that count; then the gradients
    of the loss by depth and by transmittance, real[H, W] each.
    """
    height, width = depth.shape
    grads = dict(grad_depth=device.empty(depth.shape),
                 grad_transmittance=device.empty(depth.shape))
    partials = device.empty((height, 2))
    device.launch(COMPARE, width=width, height=height, weight=weight, depth=depth,
                  transmittance=transmittance, map=known, **grads, partials=partials)
    return sum_columns(device, partials), grads["grad_depth"], grads["grad_transmittance"]


class DepthMaps(LossTerm):
    """The difference between the rendered depth and the depth map of a view that has one."""

    name = "depth"
    needs_depth = needs_map = True

    @classmethod
    def is_used(cls, options: TrainOptions) -> bool:
        """Whether there are depth maps."""
        return bool(options.depth and options.depth_weight)

    def add_to(self, grad: FrameGradient, frame: Frame, image: Array, sample: TrainingSample,
               weight: float) -> Array:
        """As `LossTerm.add_to`; returns the sums of `compare_depth`."""
        assert sample.depth is not None  # `needs_map`
        blended = frame.blended
        sums, grad_depth, grad_transmittance = compare_depth(
            self.device, blended.depth, blended.transmittance, sample.depth, weight)
        grad.add(depth=grad_depth, transmittance=grad_transmittance)
        return sums

    def weight(self, plan: object) -> float:
        """The option `depth_weight`."""
        return self.options.depth_weight

    def arrays(self, width: int, height: int, last: str) -> list[FrameArray]:
        """As `LossTerm.arrays`."""
        return [FrameArray("partials", (height, 2), None, "depth map", "depth map"),
                *(FrameArray(name, (height, width), None, "depth map", "project adjoint")
                  for name in ("grad_depth", "grad_transmittance"))]

    def results(self, width: int, height: int) -> list[ArraySpec]:
        """As `LossTerm.results`: the sums."""
        return [ArraySpec((2,))]

    def values(self, measured: list[Array]) -> dict[str, float]:
        """The mean relative error of the depth, over the pixels that count."""
        if not measured:
            return {}
        errors = np.array([sums.download() for sums in measured], np.float64)
        return {"depth_error": float(errors[:, 0].sum() / max(errors[:, 1].sum(), 1))}
