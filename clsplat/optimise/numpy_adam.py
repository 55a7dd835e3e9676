"""Adam with moments in host memory: the readable reference, and the engine of models whose moments
do not fit the device."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat import constants
from clsplat.device import Array, ArraySpec, Device
from clsplat.errors import InputError
from clsplat.gaussians import LEARNED
from clsplat.optimise.adam import HostArrays
from clsplat.optimise.rates import corrections
from clsplat.rendering.project import Gradients


class NumpyAdam:
    """Adam with its moments (`m`, `v`) in host memory; a step copies gradients and parameters only,
    and moves rows that the view does not see, too."""

    RECORDS = False  # whether a step can be recorded: this one waits for the device

    @staticmethod
    def arrays(rows: Mapping[str, Array | ArraySpec]) -> tuple[dict[str, ArraySpec], ...]:
        """As `DeviceAdam.arrays`: none on the device."""
        return {}, {}, {}

    def __init__(self, device: Device, rows: Mapping[str, Array]) -> None:
        self.device, self.steps = device, 0
        self.m, self.v = ({name: np.zeros(array.shape, array.dtype) for name, array in rows.items()} for _ in range(2))

    @staticmethod
    def numbers(step: int, rates: Mapping[str, float]) -> dict[str, float]:
        """As `DeviceAdam.numbers`."""
        return {"now": step, **{f"rate_{name}": rate for name, rate in rates.items()}}

    def catch_up_seen(
        self,
        rows: Mapping[str, Array],
        numbers: Mapping[str, float],
        degree: int,
        frozen: Array | None,
        camera: Array,
        counts: Array,
    ) -> None:
        """As `DeviceAdam.catch_up_seen`: no row lags."""

    def advance(
        self, step: int, degree: int, rows: Callable[[], Mapping[str, Array]], frozen: Array | None, counts: Array
    ) -> None:
        """As `DeviceAdam.advance`."""
        self.steps = step

    def apply(
        self,
        rows: Mapping[str, Array],
        gradients: Gradients,
        numbers: Mapping[str, float],
        degree: int,
        frozen: Array | None = None,
    ) -> None:
        """As `DeviceAdam.apply`, but waits, and moves all rows whose `frozen` is 0."""
        seen = gradients.rows.download()
        usable = seen != constants.NO_ROW
        stays = np.zeros(len(rows["positions"]), bool) if frozen is None else frozen.download() > 0
        stays[gradients.visible.download()[~usable]] = True
        moved, (first, second) = ~stays, corrections(int(numbers["now"]))
        for field in LEARNED:
            name, columns = field.name, slice(0, field.width(degree))
            if not columns.stop or not moved.any():
                continue
            values = rows[name].download()
            gradient = np.zeros_like(values)
            gradient[seen[usable]] = gradients.fields[name].download()[usable]
            parameter, slope, m, v = (
                each.reshape(len(values), -1)[:, columns] for each in (values, gradient, self.m[name], self.v[name])
            )
            slope, one = slope[moved], values.dtype.type  # Kingma & Ba 2015
            m[moved] += one(constants.ONE_MINUS_BETA1) * (slope - m[moved])
            v[moved] += one(constants.ONE_MINUS_BETA2) * (slope * slope - v[moved])
            parameter[moved] -= (
                one(numbers[f"rate_{name}"] * first)
                * m[moved]
                / (np.sqrt(v[moved]) * one(second) + one(constants.ADAM_EPSILON))
            )
            rows[name].write(values)

    def catch_up(self, rows: Mapping[str, Array], frozen: Array | None = None) -> None:
        """As `DeviceAdam.catch_up`: no row lags."""

    def current(self, rows: Mapping[str, Array], frozen: Array | None = None) -> dict[str, Array]:
        """As `DeviceAdam.current`: the rows themselves."""
        return dict(rows)

    def regrow(self, source: Array, kept: int) -> None:
        """As `DeviceAdam.regrow`."""
        kept_rows = source.narrow(kept).download()
        for moments in (self.m, self.v):
            for name, old in moments.items():
                moments[name] = np.zeros((len(source), *old.shape[1:]), old.dtype)
                moments[name][:kept] = old[kept_rows]

    def reset(self, name: str) -> None:
        """Set the moments of one field to 0."""
        self.m[name][:] = 0
        self.v[name][:] = 0

    def download(self, rows: NDArray[np.integer] | None = None) -> tuple[HostArrays, HostArrays]:
        """As `DeviceAdam.download`."""
        chosen = slice(None) if rows is None else rows
        m, v = ({name: array[chosen].copy() for name, array in moments.items()} for moments in (self.m, self.v))
        return m, v

    def upload(self, m: HostArrays, v: HostArrays) -> None:
        """As `DeviceAdam.upload`."""
        self.m, self.v = (
            {name: np.array(values, self.device.real) for name, values in moments.items()} for moments in (m, v)
        )

    def write(self, m: HostArrays, v: HostArrays, first: int) -> None:
        """As `DeviceAdam.write`."""
        for own, moments in ((self.m, m), (self.v, v)):
            for name, values in moments.items():
                own[name][first : first + len(values)] = values

    def lag(self) -> dict[str, NDArray[Any]]:
        """As `DeviceAdam.lag`."""
        return {
            "last_step": np.full(len(self.m["positions"]), self.steps, np.uint32),
            "coefficients": np.zeros((constants.CATCH_UP_EVERY, constants.LAZY_TERMS), self.device.real),
            "is_current": np.ones(1, np.uint8),
        }

    def load_lag(self, arrays: Mapping[str, NDArray[Any]], step: int) -> None:
        """As `DeviceAdam.load_lag`; InputError where a row lags."""
        if (arrays["last_step"] != step).any():
            raise InputError(
                "the checkpoint was written with Adam's moments on the device, and "
                "not all rows are up to date: go on with engine = 'device'"
            )
        self.steps = step
