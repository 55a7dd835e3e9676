"""Scene frequency: nine values against the definition, on stiff, broken and empty models."""

import numpy as np
import pytest

from clsplat.training import frequency
from clsplat.training.frequency import scene_frequency
from tests import cases
from tests.checks import close
from tests.kernels.chain import precision_of, upload_rows
from tests.reference.frequency import scene_frequency as reference

KEYS = [f"{variant}_{axis}" for variant in ("paper", "release", "robust") for axis in ("mean", "max", "min")]
MANY = 100_000


def a_model(count, seed=0):
    rng = np.random.default_rng([count, seed])
    return cases.single({"log_scales": rng.normal(-3, 1, (count, 3)), "opacity_logits": rng.uniform(-5, 5, count)})


def values(device, model):
    measured = scene_frequency(device, upload_rows(device, model))
    assert list(measured) == KEYS and all(type(value) is float for value in measured.values())
    return np.array(list(measured.values()))


def check(device, model, what):
    expected = reference(**model)
    expected = np.array([expected[key] for key in KEYS])
    # each to its own scale: they lie orders of magnitude apart
    close(values(device, model) / expected, expected / expected, precision_of(device), what)


@pytest.mark.double
@pytest.mark.oclgrind
def test_values(device, monkeypatch):
    monkeypatch.setattr(frequency, "ROWS_AN_ITEM", 2)
    full = 2 * (1 if device.form == "item" else device.group_size)
    for count in (1, 2, full - 1, full, full + 1, 3 * full + 7, 1000):
        check(device, a_model(count), f"{count} gaussians")


@pytest.mark.oclgrind
def test_without_gaussians_that_count_there_is_no_frequency(device):
    for count in (0, 1, 300):
        broken = a_model(count)
        broken["opacity_logits"][:] = np.nan
        assert np.isnan(values(device, broken)).all(), f"{count} gaussians"


def stiff_models():
    rng = np.random.default_rng(5)

    def uniform(low, high):
        return np.log(10) * rng.uniform(low, high, (MANY, 3))

    logits = rng.uniform(-40, 40, MANY)
    one_giant = uniform(-9, -8)
    one_giant[MANY // 3] = np.log(1e4)
    flat, long = uniform(-1, 1), uniform(-9, -8)
    flat[:, 1], long[:, 2] = np.log(1e-9), np.log(1e4)
    models = {
        "any size": uniform(-9, 4),
        "one giant": one_giant,
        "discs": flat,
        "needles": long,
        "all tiny": np.full((MANY, 3), np.log(1.7e-9)),
        "all huge": np.full((MANY, 3), 9.1),
        "far outside": np.sign(uniform(-1, 1)) * 87,
    }
    for name, log_scales in models.items():
        yield name, cases.single({"log_scales": log_scales, "opacity_logits": logits})
    # opacities, and even more their squares, below any single precision number
    yield "all faint", cases.single({"log_scales": uniform(-9, 4), "opacity_logits": logits - 150})


STIFF = dict(stiff_models())


@pytest.mark.parametrize("name", STIFF)
def test_stiff_models(device, name):
    check(device, STIFF[name], name)


@pytest.mark.parametrize(
    "name, slot", [("log_scales", (0,)), ("log_scales", (1,)), ("log_scales", (2,)), ("opacity_logits", ())]
)
def test_poison(device, name, slot):
    model = a_model(40)
    limits = {
        "limit": 87.0,
        "-limit": -87.0,
        "above_limit": np.nextafter(np.float32(87), 88),
        "below_limit": np.nextafter(np.float32(-87), -88),
    }
    for label, value in {**cases.POISON, **limits}.items():
        check(device, cases.poisoned(model, name, (5, *slot), value), f"{name}{slot} = {label}")


def test_opacity_and_axes_by_hand(device):
    """o = 1/2 and 1/5; sigma = 1, 2, 4 and 8, 2, 2."""
    measured = values(
        device, cases.single({"log_scales": np.log([[1, 2, 4], [8, 2, 2]]), "opacity_logits": np.log([1, 0.25])})
    )
    paper = np.array([16, 40.96])
    paper /= paper.sum()
    omega = np.array([[1.75 / 3, 1.125 / 3], [1, 0.5], [0.25, 0.125]])
    release = 1 / np.array([(7 + 12) / 6, 1.5, 6])
    robust = 0.7 / np.array([0.5 * 7 / 3 + 0.2 * 4, 0.5 * 1 + 0.2 * 2, 0.5 * 4 + 0.2 * 8])
    expected = [*(omega @ paper), *release, *robust]
    close(measured / expected, np.ones(9), "float", "two gaussians")
