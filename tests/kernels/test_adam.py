"""Adam: both engines against the reference, over steps, rows and columns.

What rows miss while no view sees them is in test_lazy_adam.py."""

from math import isqrt

import numpy as np
import pytest

from clsplat.constants import NO_ROW, STEP_SPREAD
from clsplat.gaussians import LEARNED
from clsplat.optimise.adam import DeviceAdam
from clsplat.optimise.numpy_adam import NumpyAdam
from clsplat.primitives.compact import new_counts
from clsplat.rendering.project import Gradients
from tests.checks import close
from tests.kernels.chain import precision_of
from tests.reference.adam import adam

DEGREE = 3  # rows of 45 SH coefficients: more than the item form processes at a time, and a rest
RATES = {field.name: field.rate for field in LEARNED}
WIDTHS = {field.name: field.width(DEGREE) for field in LEARNED}
ENGINES = pytest.mark.parametrize("engine", [DeviceAdam, NumpyAdam])


def random_rows(count, rng):
    return {
        field.name: rng.normal(size=(count, *field.row_shape(DEGREE))).astype(np.float32).astype(float)
        for field in LEARNED
    }


def take_step(engine, rows, gradients, step, rates, used, frozen=None):
    """A step of an engine, whose rows with a gradient have caught up with the step before."""
    degree = isqrt(used["sh_rest"] // 3 + 1) - 1
    engine.apply(rows, gradients, engine.numbers(step, rates), degree, frozen)
    engine.advance(step, degree, lambda: rows, frozen, gradients.counts)


class Run:
    """Parameters, an engine, and the same by the reference."""

    def __init__(self, device, engine, count, seed=0):
        self.device, self.rng = device, np.random.default_rng(seed)
        self.expected = random_rows(count, self.rng)
        self.first = {name: np.zeros(v.shape) for name, v in self.expected.items()}
        self.second = {name: np.zeros(v.shape) for name, v in self.expected.items()}
        self.rows = {name: device.upload(values) for name, values in self.expected.items()}
        self.engine = engine(device, self.rows)
        self.count, self.steps, self.frozen = count, 0, None

    def step(self, seen, used=WIDTHS, scale=1.0, frozen=None):
        """One step on gradients of `seen` random rows; every fifth row's is marked as not finite:
        its parameters and moments stay. So do those of `frozen` bool[N].
        """
        self.steps += 1
        rows = self.rng.permutation(self.count)[:seen].astype(np.uint32)
        fields = {name: v * scale for name, v in random_rows(seen, self.rng).items()}
        for name, values in fields.items():
            spread = np.zeros_like(self.expected[name])
            spread[rows] = values.astype(self.device.real)
            changed = np.setdiff1d(np.arange(self.count), rows[::5])
            changed = changed if frozen is None else changed[~frozen[changed]]
            columns = slice(0, used[name])
            flat = [
                a.reshape(self.count, -1)[:, columns]
                for a in (self.expected[name], spread, self.first[name], self.second[name])
            ]
            results = adam(*flat, self.steps, RATES[name], changed)
            for target, values in zip((self.expected, self.first, self.second), results):
                target[name].reshape(self.count, -1)[:, columns] = values
        visible = self.device.upload(rows)
        left_out = np.arange(seen) % 5 == 0
        if frozen is not None:
            left_out |= frozen[rows]
            frozen = self.device.upload(frozen.astype(np.uint32))
        rows[left_out] = NO_ROW
        for name in fields:
            fields[name][::5] = np.nan
        gradients = Gradients(
            {name: self.device.upload(v) for name, v in fields.items()},
            self.device.zeros((seen, 2)),
            self.device.upload(rows),
            visible,
            new_counts(self.device, seen),
        )
        self.engine.catch_up(self.rows, self.frozen)
        self.frozen = frozen
        take_step(self.engine, self.rows, gradients, self.steps, RATES, used, frozen)

    def check(self, what=""):
        precision = precision_of(self.device)
        self.engine.catch_up(self.rows, self.frozen)
        m, v = self.engine.download()
        for name in WIDTHS:
            close(self.rows[name].download(), self.expected[name], precision, f"{what} {name}")
            close(m[name], self.first[name], precision, f"{what} m of {name}")
            close(v[name], self.second[name], precision, f"{what} v of {name}")


@pytest.mark.double
@ENGINES
@pytest.mark.one_in(3)
def test_steps_on_varying_rows(device, engine):
    run = Run(device, engine, 40)
    for seen in (40, 25, 1, 0, 33):
        run.step(seen)
    run.check()


@pytest.mark.oclgrind
@ENGINES
def test_frozen_rows_stay_though_they_have_moments(device, engine):
    """Seen or not; what has been trained may come to be frozen."""
    run = Run(device, engine, 40)
    run.step(40)
    before = run.rows["positions"].download()
    frozen = np.arange(40) % 3 == 0
    for seen in (25, 1, 0, 33):
        run.step(seen, frozen=frozen)
    run.check()
    moved = (run.rows["positions"].download() != before).any(axis=1)
    assert not moved[frozen].any() and moved[~frozen].sum() > 20


@pytest.mark.oclgrind
def test_counts_around_the_group_size(device):
    """Of the device engine; a field of width 1 has as many elements as rows."""
    group = device.group_size
    for count in (1, group // STEP_SPREAD + 1, group - 1, group, group + 1):
        run = Run(device, DeviceAdam, count, seed=count)
        run.step(count)
        run.step(count)
        run.check(f"{count} rows")


@ENGINES
@pytest.mark.parametrize("degree", [0, 1, 2])
@pytest.mark.one_in(5)
def test_harmonics_that_are_not_active_stay(device, engine, degree):
    run = Run(device, engine, 20)
    before = run.rows["sh_rest"].download()
    run.step(15, {**WIDTHS, "sh_rest": 3 * degree * (degree + 2)})
    run.check()
    active = degree * (degree + 2)
    after = run.rows["sh_rest"].download()
    assert np.array_equal(after[:, active:], before[:, active:])
    assert (after[:, :active] != before[:, :active]).any() == (degree > 0)
