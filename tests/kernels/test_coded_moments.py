"""Moments in three bytes in place of eight: the codes, and Adam with them."""

import numpy as np
import pytest

from clsplat.gaussians import LEARNED
from clsplat.optimise.adam import CodedAdam, DeviceAdam
from clsplat.optimise.moments import coded_moments, moment_codes
from clsplat.primitives.compact import new_counts
from clsplat.rendering.project import Gradients
from tests.kernels.test_adam import DEGREE, RATES, WIDTHS, random_rows, take_step
from tests.reference.adam import coded_step


def test_a_code_is_the_nearest_of_its_moments_and_of_what_is_near_them():
    first, second = (
        codes.ravel() for codes in np.meshgrid(np.arange(0, 2**16, 7, dtype=np.uint16), np.arange(256, dtype=np.uint8))
    )
    m, v = coded_moments(first, second)
    usable = np.isfinite(m) & np.isfinite(v) & (abs(m) < 1e38)
    for found, codes in zip(moment_codes(m[usable], v[usable]), (first, second)):
        assert (found == codes[usable]).all()
    near = np.float32([1.2, -1.2, 3e-20, 0]), np.float32([1.7, 1e-30, 4e-9, 0])
    for found, true, bits in zip(coded_moments(*moment_codes(*near)), near, (3, 4)):
        assert np.allclose(found, true, rtol=2.0**-bits / 2, atol=0)


class CodedRun:
    """Rows with gradients in every step, and an engine."""

    def __init__(self, device, engine, count, seed=0):
        self.device, self.rng, self.count = device, np.random.default_rng(seed), count
        self.start = random_rows(count, self.rng)
        self.rows = {name: device.upload(values) for name, values in self.start.items()}
        self.engine, self.steps = engine(device, self.rows), 0

    def step(self, fields, rows=None):
        rows = np.arange(self.count, dtype=np.uint32) if rows is None else rows
        self.steps += 1
        visible = self.device.upload(rows)
        take_step(
            self.engine,
            self.rows,
            Gradients(
                {name: self.device.upload(values[rows]) for name, values in fields.items()},
                None,
                visible,
                visible,
                new_counts(self.device, len(rows)),
            ),
            self.steps,
            RATES,
            WIDTHS,
        )


@pytest.mark.oclgrind
def test_a_step_rounds_as_the_reference(float_device):
    """To the same codes, but where single precision is at a border of two."""
    run = CodedRun(float_device, CodedAdam, 2 * float_device.group_size + 5)
    for _ in range(3):
        before = run.engine.download()
        fields = random_rows(run.count, run.rng)
        run.step(fields)
        after = run.engine.download()
        expected = coded_step(before, fields, run.steps, [field.name for field in LEARNED])
        for name in RATES:
            for found, of_reference in zip(after, expected):
                assert (found[name] == of_reference[name]).mean() > 0.999, name
                assert np.allclose(found[name], of_reference[name], rtol=0.13, atol=1e-30), name


def test_what_is_kept_and_loaded_again_has_the_same_codes(float_device):
    run = CodedRun(float_device, CodedAdam, 50)
    run.step(random_rows(50, run.rng))
    m, v = run.engine.download()
    other = CodedAdam(float_device, run.rows)
    other.upload(m, v)
    for first, second in zip(run.engine.download(), other.download()):
        assert all(np.array_equal(first[name], second[name]) for name in first)
    source = float_device.upload(np.array([4, 2, 7, 7], np.uint32))
    other.regrow(source, 3)
    for grown, old in zip(other.download(), (m, v)):
        assert np.array_equal(grown["sh_rest"][:3], old["sh_rest"][[4, 2, 7]])
        assert np.array_equal(grown["quaternions"][:3], old["quaternions"][[4, 2, 7]])
        assert not grown["sh_rest"][3].any() and not grown["positions"][3].any()
    other.reset("opacity_logits")
    m, v = other.download()
    assert not m["opacity_logits"].any() and not v["opacity_logits"].any() and m["positions"].any()


def test_means_are_right_however_small_the_steps_are(float_device):
    """v moves by a thousandth in a step, far less than its codes differ, and m by a tenth."""
    run = CodedRun(float_device, CodedAdam, 200)
    fields = {name: np.full_like(values, 3e-4) for name, values in run.start.items()}
    for _ in range(300):
        run.step(fields)
    m, v = run.engine.download()
    true = 9e-8 * (1 - 0.999**300)
    for name in RATES:
        assert m[name].mean() == pytest.approx(3e-4, rel=0.01)
    every = np.concatenate([values.ravel() for values in v.values()])
    assert every.mean() == pytest.approx(true, rel=0.02)
    assert 0.01 < every.std() / true < 0.2


def test_coded_steps_lead_to_the_same_place(float_device):
    """Of noisy gradients of a bowl, by rows of which half are seen in a step."""
    ends = []
    for engine in (DeviceAdam, CodedAdam):
        run = CodedRun(float_device, engine, 100)
        for _ in range(250):
            fields = {
                name: values.download() + run.rng.normal(0, 0.3, values.shape) for name, values in run.rows.items()
            }
            run.engine.catch_up(run.rows)
            run.step(fields, np.sort(run.rng.permutation(100)[:50]).astype(np.uint32))
        run.engine.catch_up(run.rows)
        ends.append({name: values.download() - run.start[name] for name, values in run.rows.items()})
    for name in RATES:
        moved, difference = np.abs(ends[0][name]).mean(), ends[1][name] - ends[0][name]
        assert np.abs(difference).mean() < 0.05 * moved, name
        assert abs((difference * np.sign(ends[0][name])).mean()) < 0.01 * moved, name


def test_bytes_of_a_gaussian(float_device):
    rows = {field.name: float_device.empty((1000, *field.row_shape(DEGREE))) for field in LEARNED}
    (m, v, others), real = CodedAdam.arrays(rows), float_device.real
    assert sum(spec.nbytes(real) for specs in (m, v) for spec in specs.values()) == 3 * 59 * 1000
    assert others["last_step"].nbytes(real) == 4000
