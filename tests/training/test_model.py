"""The gaussians in training: rows and moments stay aligned, and both engines are one optimiser."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.densify.grow import Growth
from clsplat.gaussians import FIELDS, LEARNED, SPHERE, Gaussians
from clsplat.loss.exposure import Exposures
from clsplat.options import TrainOptions
from clsplat.primitives import gather
from clsplat.rendering.pipeline import Renderer
from clsplat.schedule.constant import Constant
from clsplat.schedule.plan import Plan, SceneFacts
from clsplat.training.growth import densify
from clsplat.training.model import Model
from clsplat.training.part import TrainingSample
from clsplat.training.parts import image_term
from clsplat.training.parts.exposures import PhotoResponses
from clsplat.training.parts.image_term import ImageTerm
from clsplat.training.step import Step
from tests import cases
from tests.kernels.chain import camera_of, size_of

DEGREE = 1
ENGINES = pytest.mark.parametrize("engine", ["device", "numpy"])


def gaussians_of(count, seed=0, fields=LEARNED):
    rng = np.random.default_rng(seed)
    return Gaussians(
        {f.name: rng.normal(size=(count, *f.row_shape(DEGREE))).astype(np.float32) for f in fields}, DEGREE
    )


def with_moments(device, engine, count, fields=LEARNED):
    """(Model, its gaussians, m, v) with moments that differ in every place."""
    given = gaussians_of(count, fields=fields)
    model = Model(device, given, engine)
    m, v = (gaussians_of(count, seed).rows for seed in (1, 2))
    model.adam.upload(m, v)
    return model, given, m, v


def growth_of(source, kept, children, spheres=False):
    """A Growth whose children lie at 100, 101, ... with log scales -1, -2, ...; spheres: all new
    rows have other anchors, children also other max_offsets."""
    new, first = len(source) - kept, len(source) - children
    place = np.arange(3 * children, dtype=np.float32).reshape(-1, 3)
    changes = {"positions": (first, 100 + place), "log_scales": (first, -1 - place)}
    if spheres:
        changes["anchors"] = kept, 200 + np.arange(3 * new, dtype=np.float32).reshape(-1, 3)
        changes["max_offsets"] = first, 300 + np.arange(children, dtype=np.float32)
    return Growth(np.array(source, np.uint32), kept, new - children, children, 0, changes)


@ENGINES
@pytest.mark.parametrize("fields", [LEARNED, FIELDS], ids=["plain", "spheres"])
@pytest.mark.parametrize(
    "source, kept, children",
    [
        ([0, 2, 5, 6, 2, 6, 1, 1, 4, 4], 4, 4),  # grows
        ([6, 3], 2, 0),  # only prunes
        ([3, 3], 0, 2),  # only children are left
        ([], 0, 0),
    ],
)
def test_rows_and_moments_follow_growth(float_device, engine, fields, source, kept, children):
    model, given, m, v = with_moments(float_device, engine, 7, fields)
    growth = growth_of(source, kept, children, spheres=fields is FIELDS)
    model.regrow(growth)
    after = model.download()
    moments = model.adam.download()
    assert after.count == model.count == len(source)
    assert list(after.rows) == [field.name for field in fields]
    for name, values in after.rows.items():
        first, new = growth.changes.get(name, (len(source), values[:0]))
        assert np.array_equal(values[:first], given.rows[name][source[:first]]), name
        assert np.array_equal(values[first:], new), name
    for values, before in zip(moments, (m, v)):
        assert values.keys() == before.keys()  # what is only carried along has none
        for name in before:
            assert np.array_equal(values[name][:kept], before[name][source[:kept]]), name
            assert not values[name][kept:].any(), name


@ENGINES
def test_chosen_rows_and_their_moments_are_those_of_all(float_device, engine, monkeypatch):
    """In several parts, and none."""
    monkeypatch.setattr(gather, "CHUNK_ROWS", 2)
    model, given, m, v = with_moments(float_device, engine, 7, FIELDS)
    for rows in (np.array([0, 3, 4, 6, 2]), np.arange(0)):
        for name, values in model.stored(rows).items():
            assert np.array_equal(values, given.rows[name][rows]), name
        for values, before in zip(model.adam.download(rows), (m, v)):
            assert all(np.array_equal(values[name], before[name][rows]) for name in before)


@ENGINES
def test_limit_opacity(float_device, engine):
    model, given, m, _ = with_moments(float_device, engine, 7)
    model.limit_opacity(-0.3)
    after = model.download()
    assert np.array_equal(after.opacity_logits, np.minimum(given.opacity_logits, np.float32(-0.3)))
    assert np.array_equal(after.positions, given.positions)
    moments = model.adam.download()
    assert not any(values["opacity_logits"].any() for values in moments)
    assert np.array_equal(moments[0]["positions"], m["positions"])


def stepping(device, engine="device", rows=None, parts=(), **options):
    """(a Step on a case of 1st degree, of these rows, a random photo's sample)."""
    case = cases.gaussians("degree_1")
    width, height = size_of(case)
    photo = np.random.default_rng(0).integers(0, 256, (3, height, width), np.uint8)
    renderer = Renderer(device, DEGREE, case["near"])
    model = Model(device, Gaussians(case_rows() if rows is None else rows, DEGREE), engine)
    step = Step(renderer, model, 1.0, 1e-3, TrainOptions(iterations=100, **options), [*parts, ImageTerm()])
    return step, TrainingSample(0, renderer.pack(camera_of(case)), device.upload(photo))


def plan_of(decay=0.5):
    return Plan(1.0, DEGREE, gathers=True, grows=False, resets_opacity=False, prunes_large=False, decay=decay)


def case_rows():
    return {k: v.astype(np.float32) for k, v in cases.gaussians("degree_1")["rows"].items()}


@pytest.mark.slow
def test_engines_agree_over_five_steps(double_device):
    """On the gradients of a render, with rates that change; in double, where Adam's division by a
    gradient of almost nothing does not turn rounding into a step."""
    before, results = case_rows(), []
    spheres = gaussians_of(len(before["positions"]), fields=FIELDS).rows
    before.update({field.name: spheres[field.name] for field in SPHERE})
    for engine in ("device", "numpy"):
        step, sample = stepping(double_device, engine, before)
        for iteration in range(1, 6):
            step.run(iteration, plan_of(iteration / 100), [sample])
        results.append((step.model.download().rows, *step.model.adam.download()))
    for field in SPHERE:  # carried along, never learned
        for rows, _, _ in results:
            assert np.array_equal(rows[field.name], before[field.name]), field.name
    for name in (field.name for field in LEARNED):
        moved, again = (rows[name] - before[name] for rows, _, _ in results)
        assert np.abs(moved).max() > 0, name
        moments = ((own[name], other[name]) for own, other in zip(results[0][1:], results[1][1:]))
        for own, other in ((moved, again), *moments):
            assert np.abs(own - other).max() <= 1e-9 * np.abs(other).max(), name


@ENGINES
@pytest.mark.one_in(6)
def test_a_row_stays_whose_gradient_is_not_finite(float_device, engine, monkeypatch):
    """Its moments too, while those that the view did not see go on by theirs."""
    responses = PhotoResponses()
    responses.exposures = Exposures(float_device, 1)
    responses.skipped = responses.exposures.skipped
    step, sample = stepping(float_device, engine, parts=[responses])
    renderer, model = step.renderer, step.model
    count, height = model.count, sample.photo.shape[1]
    moments = gaussians_of(count).rows
    model.adam.upload(moments, {name: values**2 for name, values in moments.items()})

    def spoilt(*arguments):
        sums, grad_image = whole(*arguments)
        values = grad_image.download()
        values[:, : height // 3] = np.nan
        grad_image.write(values)
        return sums, grad_image

    def kept(*arguments):
        found.append(adjoint(*arguments))
        return found[0]

    found, adjoint, whole = [], renderer.adjoint, image_term.image_loss
    monkeypatch.setattr(renderer, "adjoint", kept)
    monkeypatch.setattr(image_term, "image_loss", spoilt)
    monkeypatch.setattr(ImageTerm, "waits", True)
    before = model.download().rows, *model.adam.download()
    step.run(1, plan_of(), [sample])
    after = model.download().rows, *model.adam.download()
    seen = found[0].visible.download()
    usable = found[0].rows.download() == seen
    skipped, unseen = seen[~usable], np.delete(np.arange(count), seen)
    assert len(skipped) > 1 and usable.sum() > 1
    for name in before[1]:
        for old, new in zip(before, after):
            assert np.array_equal(new[name][skipped], old[name][skipped]), name
            assert (new[name][unseen] != old[name][unseen]).all(), name
    assert step.skipped() == (len(skipped) + 1, len(seen) + 1)  # and the view's exposure


@ENGINES
def test_what_is_held_stays_though_it_has_moments(float_device, engine):
    """Seen or not, while all others move on."""
    rows = case_rows()
    rows["opacity_logits"][:2] = -30  # too faint to be seen
    step, sample = stepping(float_device, engine, rows)
    model, count = step.model, step.count
    moments = gaussians_of(count).rows
    model.adam.upload(moments, {name: values**2 for name, values in moments.items()})
    frozen = np.arange(count) % 2 == 0
    model.frozen = float_device.upload(frozen.astype(np.uint32))
    before = model.download().rows
    step.run(1, plan_of(), [sample])
    seen = step.statistics.seen_count.download() > 0
    assert not seen[:2].any() and seen[3]
    assert not seen[frozen].any()  # none learns from what is frozen
    for name, rows in model.download().rows.items():
        moved = (rows != before[name]).reshape(count, -1).any(axis=1)
        assert np.array_equal(moved, ~frozen), name


@ENGINES
@pytest.mark.one_in(6)
def test_a_step_on_four_views_takes_the_mean_of_their_gradients(double_device, engine, monkeypatch):
    """Of three that are the same and one other, as the adjoint gave them one by one."""
    step, sample = stepping(double_device, engine, batch=4)
    renderer, model, count = step.renderer, step.model, step.count
    other = replace(sample, photo=double_device.upload(255 - sample.photo.download()))
    taken, found, adjoint = [], [], renderer.adjoint

    def kept(*arguments):
        found.append(adjoint(*arguments))
        return found[-1]

    monkeypatch.setattr(renderer, "adjoint", kept)
    monkeypatch.setattr(model.adam, "apply", lambda rows, mean, *_: taken.append(mean))
    monkeypatch.setattr(ImageTerm, "waits", True)  # or the views would share a frame
    losses = step.run(1, plan_of(), [sample, sample, sample, other])
    values = [step.values([found])["loss"] for found in losses]
    assert len(values) == 4 and values[0] == values[2] != values[3]
    [mean], seen = taken, found[0].visible.download()
    assert np.array_equal(mean.rows.download(), seen)
    for name, array in mean.fields.items():
        each = [gradients.fields[name].download() for gradients in found]
        assert np.abs(each[0] - each[3]).max() > 0, name
        assert np.allclose(array.download(), np.mean(each, axis=0), rtol=1e-12, atol=0), name
    expected = np.zeros(count)
    expected[seen] = 4
    assert np.array_equal(step.statistics.seen_count.download(), expected)  # by every view
    assert step.skipped()[1] == 4 * len(seen)


SMALL, LARGE, HUGE = 0.05, 0.2, 1.1  # of an extent of 10: cloned, split, pruned unless split
GROWS = Plan(1.0, DEGREE, gathers=True, grows=True, resets_opacity=False, prunes_large=True, decay=0.5)


def follow(device, gradients, scales, opacities=0.5, fields=LEARNED, **changes):
    """(event, Model, Gaussians before) of a step that grows at so many mean screen gradients."""
    given = gaussians_of(len(gradients), fields=fields)
    given.rows["log_scales"][:] = np.log(scales)[:, None]
    logits = np.log(np.divide(opacities, np.subtract(1, opacities)))
    given.rows["opacity_logits"][:] = logits
    if "anchors" in given.rows:
        given.rows["anchors"][:] = given.positions
        given.rows["max_offsets"][:] = np.arange(1, given.count + 1)
    options = TrainOptions(schedule="constant", grow_threshold=1.0, prune_size=0.1, **changes)
    step = Step(Renderer(device, DEGREE, 0.2), Model(device, given), 10.0, 0.01, options, [ImageTerm()])
    # a mean over the views that saw each: sums of two views
    step.statistics.grad_norm_sum.write(np.array(gradients, np.float32) * 2)
    step.statistics.seen_count.write(np.full(given.count, 2, np.uint32))
    facts = SceneFacts((640, 480), given.count, 1.0, photos=None, pixels=10**8)
    schedule = Constant(options, facts)
    event = densify(step, 7, GROWS, schedule, scoring_views=None, cameras=None)
    assert len(step.statistics.grad_norm_sum) == step.model.count
    assert not step.statistics.grad_norm_sum.download().any()
    return event, step.model, given


GRADIENTS = [1, 7, 3, 0.5, 9, 5, 8]
SCALES = [SMALL, SMALL, LARGE, SMALL, LARGE, SMALL, SMALL]


@pytest.mark.parametrize(
    "limit, cloned, split", [(0, 4, 2), (100, 4, 2), (13, 4, 2), (11, 3, 1), (9, 1, 1), (8, 0, 1), (7, 0, 0), (5, 0, 0)]
)
def test_the_limit_takes_the_highest_gradients(float_device, limit, cloned, split):
    event, model, _ = follow(float_device, GRADIENTS, SCALES, max_gaussians=limit)
    assert event == {"cloned": cloned, "split": split, "pruned": 0}
    assert model.count == 7 + cloned + split
