"""The gaussians in training: device rows that grow and shrink, and everything aligned to them."""

import numpy as np

from clsplat.gaussians import LEARNED, Gaussians
from clsplat.optimise.adam import DeviceAdam, NumpyAdam
from clsplat.primitives.gather import gather

GROWTH_ROOM = 1.5  # capacity over need, so that most growth reallocates nothing new
# share of the device's memory that parameters and moments may take before moments move to the host
DEVICE_SHARE = 0.5


class Model:
    """Rows by field on the device and an Adam engine whose moments follow them.

    `rows`: field name -> Array real[count, *row shape], the first `count` rows of `capacity`.
    """

    def __init__(self, device, gaussians, engine="auto", dense=False):
        self.device, self.sh_degree = device, gaussians.sh_degree
        self.capacity = 0
        self.adopt(gaussians)
        floats = sum(field.width(self.sh_degree) for field in LEARNED)
        needed = 3 * floats * self.capacity * device.real.itemsize
        if engine == "auto":
            fits = needed < DEVICE_SHARE * device.handle.global_mem_size
            engine = "device" if fits else "numpy"
        learned = {field.name: self._arrays[field.name] for field in LEARNED}
        self.adam = {"device": DeviceAdam, "numpy": NumpyAdam}[engine](device, learned, dense)

    def adopt(self, gaussians):
        """Take rows from the host; moments, if there are any, are not touched."""
        self.count = gaussians.count
        self.capacity = max(self.count, self.capacity)
        self._arrays = {}
        for name, values in gaussians.rows.items():
            self._arrays[name] = self.device.hold((self.capacity, *values.shape[1:]))
            self._arrays[name].write(values)

    @property
    def rows(self):
        return {name: array.narrow(self.count) for name, array in self._arrays.items()}

    def download(self):
        """The rows as host Gaussians."""
        rows = {name: array.download() for name, array in self.rows.items()}
        return Gaussians(rows, self.sh_degree)

    def regrow(self, growth):
        """Replace the rows by those a `densify.grow.Growth` names; new rows have no moments."""
        count = len(growth.source)
        self.device.trim()  # frames of another number of gaussians ask for other sizes
        if count > self.capacity:
            self.capacity = int(count * GROWTH_ROOM)
        source = self.device.upload(growth.source)
        for name, old in self._arrays.items():
            new = self.device.hold((self.capacity, *old.shape[1:]))
            self._arrays[name] = gather(self.device, old.narrow(self.count), source, new)
        self.adam.regrow(source, growth.kept, self.capacity)
        self.count = count
        for name, (first, values) in growth.changes.items():
            self._arrays[name].write(values, first)

    def limit_opacity(self, logit, which=None):
        """No opacity logit stays above `logit`, of all or of those where `which` bool[N]; their
        moments are forgotten (Kerbl et al. 2023)."""
        logits = self.rows["opacity_logits"]
        values = logits.download()
        logits.write(np.minimum(values, logit, out=values, where=True if which is None else which))
        self.adam.reset("opacity_logits")
