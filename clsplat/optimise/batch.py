"""The mean gradient of several views in one step (cl/batch.cl; Wu et al. 2025, BlockGaussian, train
with four views in each step)."""

import math
from collections.abc import Iterable, Mapping

import numpy as np

from clsplat.constants import FRAME_COUNTS
from clsplat.device import Array, Device, Forms, Kernel, each
from clsplat.device.kernel import Argument
from clsplat.gaussians import LEARNED
from clsplat.primitives.compact import compact, new_counts
from clsplat.rendering.frame_arrays import FrameArray
from clsplat.rendering.pipeline import Gradients

_COUNTS: dict[str, Argument] = dict(counts=("uint", FRAME_COUNTS))
MARK = Kernel("batch.cl", "batch_mark", each("V"), **_COUNTS, visible=("uint", "V"),
              rows=("uint", "V"), flags=("uint", "N"), keys=("uint", "N"))
ADD = Kernel("batch.cl", "batch_add", Forms(item=each("V"), group=each("V W")),
             width="uint", share="real", **_COUNTS, rows=("uint", "V"),
             gradient=("real", "V", "W"), sums=("real", "N", "W"))
ROWS = Kernel("batch.cl", "batch_rows", each("V"), **_COUNTS, visible=("uint", "V"),
              keys=("uint", "N"), rows=("uint", "V"))
TAKE = Kernel("batch.cl", "batch_take", each("V W"), width="uint", **_COUNTS,
              visible=("uint", "V"), sums=("real", "N", "W"), mean=("real", "V", "W"))


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
            *indices(seen, "before_rows", "cull", "project adjoint"),
            *indices(seen, "before_visible", "cull", "project adjoint"),
            FrameArray("before_means", (seen, 2), None, "cull", "project adjoint"),
            *indices(count, "visible rows", "adam", "adam"),
            *fields(seen, "mean", "adam", "adam")]


def batch_mean(device: Device, count: int, views: int, by_view: Iterable[Gradients],
               used: Mapping[str, int], counts: Array | None = None, room: int | None = None
               ) -> Gradients:
    """The gradients of the mean of the losses of several views, without those by screen means.

    The gradient of a gaussian is zero in a view that does not see it, and is left out if it is not
    finite in one of the views.

    Parameters
    ----------
    device : the device of the gradients.
    count : gaussians of the model.
    views : how many views.
    by_view : the gradients of each view, whose counts need to hold only until the next.
    used : field name -> how many floats of a row change; fields of 0 are left out.
    counts : uint[FRAME_COUNTS], whose COUNT_VISIBLE becomes the number of gaussians that a view
        sees; None: new ones.
    room : the largest such number that is expected, so that nothing waits for the device; where
        there are more, the frame fails (cl/include/counts.h). None: exact sizes; waits.
    """
    flags, keys = device.empty(count, np.uint32), device.empty(count, np.uint32)
    flags.fill(0)
    sums: dict[str, Array] = {}
    for gradients in by_view:
        device.launch(MARK, counts=gradients.counts, visible=gradients.visible,
                      rows=gradients.rows, flags=flags, keys=keys)
        for name, gradient in gradients.fields.items():
            if not used[name]:
                continue
            if name not in sums:
                sums[name] = device.empty((count, *gradient.shape[1:]))
                sums[name].fill(0)
            width = math.prod(gradient.shape[1:])
            device.launch(ADD, width=width, share=1 / views, counts=gradients.counts,
                          rows=gradients.rows, gradient=gradient.reshaped(len(gradient), width),
                          sums=sums[name].reshaped(count, width))
    counts = new_counts(device) if counts is None else counts
    visible = compact(device, flags, counts, room)
    rows, fields = device.empty(len(visible), np.uint32), {}
    device.launch(ROWS, counts=counts, visible=visible, keys=keys, rows=rows)
    for name, values in sums.items():
        width = math.prod(values.shape[1:])
        fields[name] = device.empty((len(visible), *values.shape[1:]))
        device.launch(TAKE, width=width, counts=counts, visible=visible,
                      sums=values.reshaped(count, width),
                      mean=fields[name].reshaped(len(visible), width))
    return Gradients(fields, None, rows, visible, counts)
