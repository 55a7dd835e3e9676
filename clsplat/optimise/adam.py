"""Adam on the rows of the gaussians: one definition, two engines (cl/adam.cl).

`DeviceAdam` is one fused kernel a field. `NumpyAdam` is the readable reference and keeps the
moments in host memory, for models whose moments do not fit the device. Both are dense, moving and
decaying every row at every step as Adam does, or sparse: only the rows that the view saw. Dense
learns faster (on our sets 0.5 to 1 dB ahead after 1000 steps) and costs about the same. Both leave
a row whose gradient was not finite as it is, moments too.
"""

import math

import numpy as np

from clsplat.constants import ADAM_EPSILON, NO_ROW, ONE_MINUS_BETA1, ONE_MINUS_BETA2
from clsplat.device import ArraySpec, Forms, Kernel, each
from clsplat.gaussians import LEARNED
from clsplat.primitives.gather import gather, scatter
from clsplat.rendering.frame_arrays import FrameArray

_COLUMNS = Forms(item=each("count"), group=each("count used"))
_ARGUMENTS = dict(count="uint", stride="uint", used="uint", rate="real", correction="real")
_MOMENTS = dict(gradient=("real", "V", "W"), parameter=("real", "N", "W"), m=("real", "N", "W"),
                v=("real", "N", "W"))
ROWS = Kernel("adam.cl", "adam_rows", _COLUMNS, **_ARGUMENTS, rows=("uint", "V"), **_MOMENTS)
ALL = Kernel("adam.cl", "adam_all", _COLUMNS, **_ARGUMENTS, places=("uint", "N"), **_MOMENTS)
INVERT = Kernel("adam.cl", "invert_rows", each("count"), count="uint", visible=("uint", "V"),
                rows=("uint", "V"), places=("uint", "N"))
FREEZE_PLACES = Kernel("adam.cl", "freeze_places", each("count"), count="uint",
                       frozen=("uint", "N"), places=("uint", "N"))
FREEZE_ROWS = Kernel("adam.cl", "freeze_rows", each("count"), count="uint", visible=("uint", "V"),
                     frozen=("uint", "N"), rows=("uint", "V"))


def freeze_rows(device, gradients, frozen):
    """Take the rows of frozen gaussians from the Gradients, so that nothing follows these.

    frozen : uint[N] on the device, not 0 where a gaussian stays as it is
    """
    device.launch(FREEZE_ROWS, count=len(gradients.rows), visible=gradients.visible, frozen=frozen,
                  rows=gradients.rows)


def corrections(step):
    """The bias corrections 1 / (1 - beta1^t) and 1 / sqrt(1 - beta2^t) of step t, from 1."""
    beta1, beta2 = 1 - ONE_MINUS_BETA1, 1 - ONE_MINUS_BETA2
    return 1 / (1 - beta1**step), 1 / float(np.sqrt(1 - beta2**step))


def _flat(array):
    return array.reshaped(len(array), math.prod(array.shape[1:]))


class DeviceAdam:
    """Moments on the device. `m`, `v`: field name -> Array shaped as the parameter."""

    def __init__(self, device, rows, dense=False):
        self.device, self.dense, self.count = device, dense, len(rows["positions"])
        self.m, self.v = ({name: device.zeros(*spec) for name, spec in moments.items()}
                          for moments in self.arrays(rows))

    @staticmethod
    def arrays(rows):
        """The arrays of m and of v by field, for `rows` with a shape each."""
        moments = {name: ArraySpec(array.shape) for name, array in rows.items()}
        return moments, moments

    @staticmethod
    def frame_arrays(count, seen, sh_degree, dense):
        """What a step allocates for `count` rows, `seen` of them in the view."""
        return [FrameArray("places", (count,), np.uint32, "adam", "adam")] if dense else []

    def step(self, rows, gradients, step, rates, used, frozen=None):
        """Update parameters `rows` (field -> real[N, ...]) in place.

        gradients : Gradients of rendering.pipeline, without the rows of frozen gaussians
            (`freeze_rows`)
        step : from 1
        rates : field -> learning rate
        used : field -> leading floats of a row that may change; 0 leaves a field alone
        frozen : uint[N] on the device; where it is not 0, rows keep parameters and moments even if
            no view sees them; None: no row is frozen
        """
        device, seen, count = self.device, gradients.rows, len(rows["positions"])
        first, second = corrections(step)
        if self.dense:
            places = device.empty(count, np.uint32)
            if frozen is None:
                places.fill(NO_ROW)
            else:
                device.launch(FREEZE_PLACES, count=count, frozen=frozen, places=places)
            device.launch(INVERT, count=len(seen), visible=gradients.visible, rows=seen,
                          places=places)
        for name, parameter in rows.items():
            if not used[name]:
                continue
            gradient = _flat(gradients.fields[name])
            values = dict(
                stride=gradient.shape[1], used=used[name], rate=rates[name] * first,
                correction=second, gradient=gradient, parameter=_flat(parameter),
                m=_flat(self.m[name].narrow(count)), v=_flat(self.v[name].narrow(count)))
            if self.dense:
                device.launch(ALL, count=count, places=places, **values)
            else:
                device.launch(ROWS, count=len(seen), rows=seen, **values)

    def regrow(self, source, kept, capacity):
        """Follow the rows: the first `kept` of `source` uint[M] are old, the rest start new."""
        for moments in (self.m, self.v):
            for name, old in moments.items():
                new = self.device.zeros((capacity, *old.shape[1:]))
                moments[name] = gather(self.device, old.narrow(self.count), source.narrow(kept),
                                       new)
        self.count = len(source)

    def reset(self, name):
        """Forget the moments of one field."""
        self.m[name].fill(0)
        self.v[name].fill(0)

    def download(self, count):
        """(m, v) as host arrays by field, the first `count` rows."""
        return tuple({name: array.narrow(count).download() for name, array in moments.items()}
                     for moments in (self.m, self.v))

    def upload(self, m, v):
        """Take moments over from host arrays by field."""
        for own, given in ((self.m, m), (self.v, v)):
            for name, values in given.items():
                own[name].write(values)


class NumpyAdam:
    """Moments in host memory; only gradients and changed parameters cross to the device."""

    @staticmethod
    def arrays(rows):
        """As `DeviceAdam.arrays`: none on the device."""
        return {}, {}

    @staticmethod
    def frame_arrays(count, seen, sh_degree, dense):
        """As `DeviceAdam.frame_arrays`; what is learned goes to the host and back."""
        moved = count if dense else seen
        return [FrameArray("touched", (moved,), np.uint32, "adam", "adam"),
                *(FrameArray(field.name, (moved, *field.row_shape(sh_degree)), None, "adam", "adam")
                  for field in LEARNED)]

    def __init__(self, device, rows, dense=False):
        self.device, self.dense = device, dense
        self.m = {name: np.zeros(array.shape, array.dtype) for name, array in rows.items()}
        self.v = {name: np.zeros(array.shape, array.dtype) for name, array in rows.items()}

    def step(self, rows, gradients, step, rates, used, frozen=None):
        """As `DeviceAdam.step`."""
        count = len(rows["positions"])
        seen = gradients.rows.download()
        usable = seen != NO_ROW
        touched = seen[usable]
        if self.dense:
            stays = np.zeros(count, bool) if frozen is None else frozen.download() > 0
            stays[gradients.visible.download()[~usable]] = True
            touched = np.flatnonzero(~stays).astype(np.uint32)
            places = np.searchsorted(touched, seen[usable])
        touched_device = self.device.upload(touched)
        for field in LEARNED:
            name, columns = field.name, slice(0, used[field.name])
            if not used[name] or not len(touched):
                continue
            parameter = gather(self.device, rows[name], touched_device)
            values, gradient = parameter.download(), gradients.fields[name].download()
            if self.dense:
                spread = np.zeros_like(values)
                spread[places] = gradient[usable]
                gradient = spread
            else:
                gradient = gradient[usable]
            flat = values.reshape(len(values), -1)
            m, v = (moments[name].reshape(len(moments[name]), -1) for moments in (self.m, self.v))
            flat[:, columns], m[touched, columns], v[touched, columns] = adam_update(
                flat[:, columns], gradient.reshape(len(values), -1)[:, columns],
                m[touched, columns], v[touched, columns], step, rates[name])
            parameter.write(values)
            scatter(self.device, parameter, touched_device, rows[name])

    def regrow(self, source, kept, capacity):
        """As `DeviceAdam.regrow`."""
        kept_rows = source.narrow(kept).download()
        for moments in (self.m, self.v):
            for name, old in moments.items():
                moments[name] = np.zeros((capacity, *old.shape[1:]), old.dtype)
                moments[name][:kept] = old[kept_rows]

    def reset(self, name):
        """Forget the moments of one field."""
        self.m[name][:] = 0
        self.v[name][:] = 0

    def download(self, count):
        """As `DeviceAdam.download`."""
        return tuple({name: array[:count].copy() for name, array in moments.items()}
                     for moments in (self.m, self.v))

    def upload(self, m, v):
        """As `DeviceAdam.upload`."""
        for own, given in ((self.m, m), (self.v, v)):
            for name, values in given.items():
                own[name][:len(values)] = values


def adam_update(parameter, gradient, m, v, step, rate):
    """(parameter, m, v) after one step of Adam (Kingma & Ba 2015), arrays of one shape."""
    first, second = corrections(step)
    one = parameter.dtype.type
    m = m + one(ONE_MINUS_BETA1) * (gradient - m)
    v = v + one(ONE_MINUS_BETA2) * (gradient * gradient - v)
    moved = one(rate * first) * m / (np.sqrt(v) * one(second) + one(ADAM_EPSILON))
    return parameter - moved, m, v
