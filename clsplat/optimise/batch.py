"""One step's gradients from several views (cl/batch.cl), as BlockGaussian's paper trains (Wu et al.
2025: four views a step)."""

import math

import numpy as np

from clsplat.device import Forms, Kernel, each
from clsplat.gaussians import LEARNED
from clsplat.primitives.gather import compact, gather
from clsplat.rendering.frame_arrays import FrameArray
from clsplat.rendering.pipeline import Gradients

MARK = Kernel("batch.cl", "batch_mark", each("count"), count="uint", visible=("uint", "V"),
              rows=("uint", "V"), flags=("uint", "N"), keys=("uint", "N"))
ADD = Kernel("batch.cl", "batch_add", Forms(item=each("count"), group=each("count width")),
             count="uint", width="uint", share="real", rows=("uint", "V"),
             gradient=("real", "V", "W"), sums=("real", "N", "W"))


def frame_arrays(count, seen, sh_degree):
    """What `batch_mean` holds for `count` gaussians, `seen` of them in a view, beside the arrays of
    a view: those of the view before, and sums."""
    def fields(rows, what, first, last):
        return [FrameArray(f"{what}_{field.name}", (rows, *field.row_shape(sh_degree)), None, first,
                           last) for field in LEARNED]

    def numbers(rows, names, first, last):
        return [FrameArray(name, (rows,), np.uint32, first, last) for name in names.split()]

    return [*numbers(count, "flags keys", "cull", "adam"), *fields(count, "sum", "cull", "adam"),
            *fields(seen, "before", "cull", "project adjoint"),
            *numbers(seen, "before_rows", "cull", "project adjoint"),
            *numbers(count, "before_visible", "cull", "project adjoint"),
            FrameArray("before_means", (seen, 2), None, "cull", "project adjoint"),
            *numbers(count, "offsets kept_keys kept", "adam", "adam"),
            *fields(seen, "mean", "adam", "adam")]


def batch_mean(device, count, views, found, used):
    """The Gradients of the mean of the losses of so many `views`, without screen means.

    count: rows of gaussians; found: iterable of each view's Gradients; used: field -> floats of a
    row that will be used: a field of 0 is left out. A view that does not see a row counts as a
    gradient of zero. A row that one of them marks as not to be followed has no row in the result
    either.
    """
    flags, keys = device.empty(count, np.uint32), device.empty(count, np.uint32)
    flags.fill(0)
    sums = {}
    for gradients in found:
        seen = len(gradients.rows)
        device.launch(MARK, count=seen, visible=gradients.visible, rows=gradients.rows, flags=flags,
                      keys=keys)
        for name, gradient in gradients.fields.items():
            if not used[name]:
                continue
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
