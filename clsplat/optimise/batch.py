"""The mean gradient of several views in one step (cl/batch.cl; Wu et al. 2025, BlockGaussian, train
with four views in each step)."""

import math
from collections.abc import Iterable, Mapping

import numpy as np

from clsplat.device import Array, Device, Forms, Kernel, each
from clsplat.gaussians import LEARNED
from clsplat.primitives.gather import compact, gather
from clsplat.rendering.frame_arrays import FrameArray
from clsplat.rendering.pipeline import Gradients

MARK = Kernel("batch.cl", "batch_mark", each("count"), count="uint", visible=("uint", "V"),
              rows=("uint", "V"), flags=("uint", "N"), keys=("uint", "N"))
ADD = Kernel("batch.cl", "batch_add", Forms(item=each("count"), group=each("count width")),
             count="uint", width="uint", share="real", rows=("uint", "V"),
             gradient=("real", "V", "W"), sums=("real", "N", "W"))


def frame_arrays(count: int, seen: int, sh_degree: int) -> list[FrameArray]:
    """The arrays of `batch_mean` besides those of one view: sums, and gradients of the view before.

    Parameters
    ----------
    count : gaussians.
    seen : gaussians that a view sees.
    sh_degree : of the stored spherical harmonics.
    """
    def fields(rows: int, what: str, first: str, last: str) -> list[FrameArray]:
        return [FrameArray(f"{what}_{field.name}", (rows, *field.row_shape(sh_degree)), None, first,
                           last) for field in LEARNED]

    def indices(rows: int, names: str, first: str, last: str) -> list[FrameArray]:
        return [FrameArray(name, (rows,), np.uint32, first, last) for name in names.split()]

    return [*indices(count, "flags keys", "cull", "adam"), *fields(count, "sum", "cull", "adam"),
            *fields(seen, "before", "cull", "project adjoint"),
            *(FrameArray(name, (seen, 3), None, "cull", "project adjoint")
              for name in ("before_colours", "before_directions")),
            *(FrameArray(f"grad_{field.name}", (seen, *field.row_shape(sh_degree)), None, "adam",
                         "adam") for field in LEARNED if field.name.startswith("sh_")),
            *indices(seen, "before_rows", "cull", "project adjoint"),
            *indices(count, "before_visible", "cull", "project adjoint"),
            FrameArray("before_means", (seen, 2), None, "cull", "project adjoint"),
            *indices(count, "offsets kept_keys kept", "adam", "adam"),
            *fields(seen, "mean", "adam", "adam")]


def batch_mean(device: Device, count: int, views: int, by_view: Iterable[Gradients],
               used: Mapping[str, int]) -> Gradients:
    """The gradients of the mean of the losses of several views, without those by screen means.

    The gradient of a gaussian is zero in a view that does not see it, and is left out if it is not
    finite in one of the views.

    Parameters
    ----------
    device : the device of the gradients.
    count : gaussians of the model.
    views : how many views.
    by_view : the gradients of each view.
    used : field name -> how many floats of a row change; fields of 0 are left out.
    """
    flags, keys = device.empty(count, np.uint32), device.empty(count, np.uint32)
    flags.fill(0)
    sums: dict[str, Array] = {}
    for gradients in by_view:
        seen = len(gradients.rows)
        device.launch(MARK, count=seen, visible=gradients.visible, rows=gradients.rows, flags=flags,
                      keys=keys)
        for name in gradients.fields:
            if not used[name]:
                continue
            gradient = gradients.fields[name]
            if name not in sums:
                sums[name] = device.empty((count, *gradient.shape[1:]))
                sums[name].fill(0)
            width = math.prod(gradient.shape[1:])
            device.launch(ADD, count=seen, width=width, share=1 / views, rows=gradients.rows,
                          gradient=gradient.reshaped(seen, width),
                          sums=sums[name].reshaped(count, width))
    rows, visible = compact(device, flags, keys)
    fields = {name: gather(device, values, visible) for name, values in sums.items()}
    return Gradients(fields, None, rows, visible)
