"""The gaussians in training: rows on the device, and the Adam moments aligned with them."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from clsplat.densify.grow import Growth
from clsplat.device import Array, ArraySpec, Device
from clsplat.gaussians import FIELDS, LEARNED, Gaussians
from clsplat.optimise.adam import CodedAdam, DeviceAdam
from clsplat.optimise.numpy_adam import NumpyAdam
from clsplat.primitives.gather import gather

# of the device's memory; beyond it, the moments are kept on the host: frames take as much again
# and photos a quarter
DEVICE_SHARE = 1 / 3
Adam = DeviceAdam | NumpyAdam
ENGINES: dict[str, type[Adam]] = {
    "device": DeviceAdam, "coded": CodedAdam, "numpy": NumpyAdam}


class Model:
    """Rows of gaussians on the device, and an Adam engine whose moments follow them.

    The moments are kept by `engine` "device", "coded" or "numpy".
    `layout` is another object after each change of the arrays or of the number of gaussians.
    """

    def __init__(self, device: Device, gaussians: Gaussians, engine: str = "device") -> None:
        self.device, self.sh_degree = device, gaussians.sh_degree
        self.frozen: Array | None = None  # uint[count], not 0 for those that are not trained
        self.count, self.layout = gaussians.count, object()
        self._arrays = {name: device.upload(values) for name, values in gaussians.rows.items()}
        self.adam: Adam = ENGINES[engine](
            device, {field.name: self._arrays[field.name] for field in LEARNED})

    @staticmethod
    def arrays(names: Iterable[str], sh_degree: int, count: int) -> dict[str, ArraySpec]:
        """The device arrays of the named fields."""
        shapes = {field.name: field.row_shape(sh_degree) for field in FIELDS}
        return {name: ArraySpec((count, *shapes[name])) for name in names}

    @property
    def rows(self) -> dict[str, Array]:
        """Field name -> real[count, *row shape], the arrays of the model.

        Gaussians that no view saw may lag behind the last step (`catch_up`, `current_rows`).
        """
        return dict(self._arrays)

    def catch_up(self) -> None:
        """Bring all gaussians up to the last step.

        This rounds, so when it is done must follow from the options alone.
        """
        self.adam.catch_up(self.rows, self.frozen)

    def current_rows(self) -> dict[str, Array]:
        """The rows after the last step, for whoever looks at the model at any time: copies, unless
        all have caught up."""
        return self.adam.current(self.rows, self.frozen)

    def download(self, stored: bool = False) -> Gaussians:
        """Copy the rows to the host: `current_rows`, or for a checkpoint the stored ones."""
        rows = self.rows if stored else self.current_rows()
        return Gaussians({name: array.download() for name, array in rows.items()}, self.sh_degree)

    def regrow(self, growth: Growth) -> None:
        """Replace the rows as a round of growth requires; new rows have no moments.

        All rows are copied, field by field, into arrays of the new size: room for later rounds
        would save no copy.
        """
        self.catch_up()
        self.count, self.layout = len(growth.source), object()
        self.device.trim()  # frames of another number of gaussians need other sizes
        source = self.device.upload(growth.source)
        for name, old in self._arrays.items():
            new = self.device.allocate((self.count, *old.shape[1:]))
            self._arrays[name] = gather(self.device, old, source, new)
        self.adam.regrow(source, growth.kept)
        for name, (first, values) in growth.changes.items():
            self._arrays[name].write(values, first)

    def limit_opacity(self, logit: float) -> None:
        """Limit opacity logits, of the gaussians that are trained, and reset the moments of all
        opacities (Kerbl et al. 2023)."""
        self.catch_up()
        logits = self.rows["opacity_logits"]
        values, trained = logits.download(), self.frozen is None or self.frozen.download() == 0
        logits.write(np.minimum(values, logit, out=values, where=trained))
        self.adam.reset("opacity_logits")


def model_bytes(device: Device, sh_degree: int, count: int, engine: str) -> int:
    """Bytes of parameters and moments on a device, with an engine of ENGINES."""
    rows = Model.arrays([field.name for field in LEARNED], sh_degree, count)
    return sum(spec.nbytes(device.real) for specs in (rows, *ENGINES[engine].arrays(rows))
               for spec in specs.values())


def checkpoint_bytes(count: int, sh_degree: int) -> int:
    """Approximate size in bytes of checkpoint and finished model, of `count` gaussians."""
    floats = sum(field.width(sh_degree) for field in LEARNED)
    return 4 * 4 * floats * count  # parameters, two moments, and the PLY file
