"""The gaussians in training: rows and moments stay aligned, and both engines are one optimiser."""

import numpy as np
import pytest

from clsplat.densify.grow import Growth
from clsplat.gaussians import LEARNED, Gaussians
from clsplat.options import TrainOptions
from clsplat.render.pipeline import Renderer
from clsplat.schedule import Plan
from clsplat.train.model import Model
from clsplat.train.step import Step
from tests import cases
from tests.kernels.chain import camera_of, size_of

DEGREE = 1
ENGINES = pytest.mark.parametrize("engine", ["device", "numpy"])


def gaussians_of(count, seed=0):
    rng = np.random.default_rng(seed)
    return Gaussians({f.name: rng.normal(size=(count, *f.row_shape(DEGREE))).astype(np.float32)
                      for f in LEARNED}, DEGREE)


def with_moments(device, engine, count):
    """(Model, its gaussians, m, v) with moments that differ in every place."""
    given = gaussians_of(count)
    model = Model(device, given, engine)
    m, v = (gaussians_of(count, seed).rows for seed in (1, 2))
    model.adam.upload(m, v)
    return model, given, m, v


def growth_of(source, kept, children, cloned=0):
    """A Growth whose children lie at 100, 101, ... with log scales -1, -2, ..."""
    place = np.arange(3 * children, dtype=np.float32).reshape(-1, 3)
    return Growth(np.array(source, np.uint32), kept, slice(len(source) - children, len(source)),
                  100 + place, -1 - place, cloned, 0)


@ENGINES
@pytest.mark.parametrize("source, kept, children", [
    ([0, 2, 5, 6, 2, 6, 1, 1, 4, 4], 4, 4),  # grows past the capacity
    ([6, 3], 2, 0),  # only prunes
    ([3, 3], 0, 2),  # only children are left
    ([], 0, 0),
])
def test_rows_and_moments_follow_growth(float_device, engine, source, kept, children):
    model, given, m, v = with_moments(float_device, engine, 7)
    growth = growth_of(source, kept, children)
    model.regrow(growth)
    after = model.download()
    moments = model.adam.download(model.count)
    assert after.count == model.count == len(source)
    old = slice(0, len(source) - children)
    for name in after.rows:
        replaced = children and name in ("positions", "log_scales")
        shown = old if replaced else slice(None)
        assert np.array_equal(after.rows[name][shown], given.rows[name][source][shown]), name
        for values, before in zip(moments, (m, v)):
            assert np.array_equal(values[name][:kept], before[name][source[:kept]]), name
            assert not values[name][kept:].any(), name
    assert np.array_equal(after.positions[growth.split], growth.positions)
    assert np.array_equal(after.log_scales[growth.split], growth.log_scales)


@ENGINES
def test_growth_upon_growth(float_device, engine):
    """Capacity is room, never content: what shrank may grow again."""
    model, given, m, _ = with_moments(float_device, engine, 7)
    model.regrow(growth_of([0, 1, 2, 3, 4, 5, 6, 0, 1, 2], 7, 0))
    capacity = model.capacity
    assert capacity >= 10
    model.regrow(growth_of([4, 5], 2, 0))
    model.regrow(growth_of([1, 0, 1], 2, 0))
    assert model.capacity == capacity
    assert np.array_equal(model.download().positions, given.positions[[5, 4, 5]])
    assert np.array_equal(model.adam.download(3)[0]["quaternions"][:2], m["quaternions"][[5, 4]])
    assert not model.adam.download(3)[0]["quaternions"][2].any()


@ENGINES
def test_limit_opacity(float_device, engine):
    model, given, m, _ = with_moments(float_device, engine, 7)
    model.limit_opacity(-0.3)
    after = model.download()
    assert np.array_equal(after.opacity_logits, np.minimum(given.opacity_logits, np.float32(-0.3)))
    assert np.array_equal(after.positions, given.positions)
    moments = model.adam.download(7)
    assert not any(values["opacity_logits"].any() for values in moments)
    assert np.array_equal(moments[0]["positions"], m["positions"])


def test_moments_move_to_the_host_where_they_do_not_fit(float_device, monkeypatch):
    def kind(engine):
        return type(Model(float_device, gaussians_of(4), engine).adam).__name__

    assert kind("auto") == "DeviceAdam"
    monkeypatch.setattr("clsplat.train.model.DEVICE_SHARE", 0)
    assert (kind("auto"), kind("device")) == ("NumpyAdam", "DeviceAdam")


@pytest.mark.parametrize("optimizer", ["sparse", "dense"])
def test_engines_agree_over_five_steps(double_device, optimizer):
    """On the gradients of a render, with rates that change; in double, where Adam's division by a
    gradient of almost nothing does not turn rounding into a step."""
    device = double_device
    case = cases.gaussians("degree_1")
    width, height = size_of(case)
    photo = np.random.default_rng(0).integers(0, 256, (3, height, width), np.uint8)
    plan = Plan(1.0, DEGREE, gathers=True, grows=False, resets_opacity=False, prunes_large=False)
    results = []
    for engine in ("device", "numpy"):
        renderer = Renderer(device, DEGREE, case["near"])
        given = Gaussians({k: v.astype(np.float32) for k, v in case["rows"].items()}, DEGREE)
        model = Model(device, given, engine, optimizer == "dense")
        step = Step(renderer, model, 1.0, TrainOptions(iterations=100))
        for iteration in range(1, 6):
            step.take(iteration, plan, renderer.pack(camera_of(case)), device.upload(photo))
        results.append((model.download().rows, *model.adam.download(model.count)))
    before = given.rows
    for name in before:
        moved, again = (rows[name] - before[name] for rows, _, _ in results)
        assert np.abs(moved).max() > 0, name
        moments = ((own[name], other[name]) for own, other in zip(results[0][1:], results[1][1:]))
        for own, other in ((moved, again), *moments):
            assert np.abs(own - other).max() <= 1e-9 * np.abs(other).max(), name
