"""The mean gradient of several views in one step (cl/batch.cl; Wu et al. 2025, BlockGaussian, train
with four views in each step)."""

import math
from collections.abc import Mapping

import numpy as np

from clsplat.constants import FRAME_COUNTS
from clsplat.device import Array, Device, Forms, Kernel, each
from clsplat.device.kernel import Argument
from clsplat.primitives.compact import compact
from clsplat.rendering.project import Gradients

_COUNTS: dict[str, Argument] = dict(counts=("uint", FRAME_COUNTS))
MARK = Kernel(
    "batch.cl",
    "batch_mark",
    each("V"),
    **_COUNTS,
    visible=("uint", "V"),
    rows=("uint", "V"),
    flags=("uint", "N"),
    keys=("uint", "N"),
)
ADD = Kernel(
    "batch.cl",
    "batch_add",
    Forms(item=each("V"), group=each("V W")),
    width="uint",
    share="real",
    **_COUNTS,
    rows=("uint", "V"),
    gradient=("real", "V", "W"),
    sums=("real", "N", "W"),
)
ROWS = Kernel(
    "batch.cl",
    "batch_rows",
    each("V"),
    **_COUNTS,
    visible=("uint", "V"),
    keys=("uint", "N"),
    flags=("uint", "N"),
    rows=("uint", "V"),
)
TAKE = Kernel(
    "batch.cl",
    "batch_take",
    each("V W"),
    width="uint",
    **_COUNTS,
    visible=("uint", "V"),
    sums=("real", "N", "W"),
    mean=("real", "V", "W"),
)


class BatchMean:
    """Gradients of the mean of the losses of several views, without those by screen means.

    The gradient of a gaussian is zero in a view that does not see it, and is left out if it is not
    finite in one of the views. `rows`, the parameters, give the shapes.
    """

    def __init__(self, device: Device, rows: Mapping[str, Array], views: int) -> None:
        self.device, self.views, self.count = device, views, len(rows["positions"])
        # all are zero between batches
        self._flags, self._keys = (device.zeros(self.count, np.uint32) for _ in range(2))
        self._sums = {
            name: device.zeros((self.count, *array.shape[1:]))
            for name, array in rows.items()
            if array.dtype == device.real
        }

    def add(self, gradients: Gradients, degree: int) -> None:
        """Add the gradients of a view; `degree` is that of the active harmonics."""
        device, counts = self.device, gradients.counts
        device.launch(
            MARK, counts=counts, visible=gradients.visible, rows=gradients.rows, flags=self._flags, keys=self._keys
        )
        for name, sums in self._sums.items():
            if degree or name != "sh_rest":
                gradient, width = gradients.fields[name], math.prod(sums.shape[1:])
                device.launch(
                    ADD,
                    width=width,
                    share=1 / self.views,
                    counts=counts,
                    rows=gradients.rows,
                    gradient=gradient.reshaped(len(gradient), width),
                    sums=sums.reshaped(self.count, width),
                )

    def mean(self, counts: Array, degree: int, room: int | None) -> Gradients:
        """The mean of the views that were added; begins the next batch.

        COUNT_VISIBLE of `counts` becomes the number of gaussians that any of the views saw; after a
        frame that failed, 0. `degree` is as for `add`, `room` as for `compact`.
        """
        device = self.device
        visible = compact(device, self._flags, counts, room)
        rows, fields = device.empty(len(visible), np.uint32), {}
        device.launch(ROWS, counts=counts, visible=visible, keys=self._keys, flags=self._flags, rows=rows)
        for name, sums in self._sums.items():
            if degree or name != "sh_rest":
                width = math.prod(sums.shape[1:])
                fields[name] = device.empty((len(visible), *sums.shape[1:]))
                device.launch(
                    TAKE,
                    width=width,
                    counts=counts,
                    visible=visible,
                    sums=sums.reshaped(self.count, width),
                    mean=fields[name].reshaped(len(visible), width),
                )
        return Gradients(fields, None, rows, visible, counts)
