"""Stiff trainings end well, or end plainly: finite numbers, and a line that says what is wrong."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.io.models.ply import read_ply, write_ply
from clsplat.training import step
from clsplat.training.photos import Thumbnails
from clsplat.training.start.initialise import initial_gaussians
from clsplat.training.start.prepare import find_warnings
from tests.adversarial.extreme import stiff
from tests.adversarial.extreme.stiff import CASES, rescaled
from tests.data.tiny_training import LEVELLED, options_of, records, trained

SCHEDULES = {"constant": {"reset_every": 0}, "sig": {**LEVELLED, "reproject": "auto"}}
STEPS = 200
# nothing is left of these models, and what ends a training is said
EMPTIED = {"transparent"}


def prepared(city, case, schedule, folder):
    """(Scene, options as keywords) of a case."""
    scene = case.scene(stiff.thinned(city, stiff.SAMPLE), folder)
    options = {**SCHEDULES[schedule], "iterations": STEPS}
    options |= {name: value for name, value in case.options.items()
                if schedule == "sig" or not name.startswith("sphere")}
    if case.gaussians:
        options["init"] = str(stiff.written(scene, case, folder / "initial.ply"))
    return scene, options


@pytest.mark.nightly
@pytest.mark.parametrize("name, schedule", list(zip(CASES, itertools.cycle(SCHEDULES))))
def test_stiff(city, item_device, tmp_path, monkeypatch, name, schedule):
    case = CASES[name]
    scene, options = prepared(city, case, schedule, tmp_path)
    rates = step.learning_rates
    monkeypatch.setattr(step, "learning_rates", lambda *given: {
        field: case.rates * rate for field, rate in rates(*given).items()})
    refusal = "all gaussians were pruned" if name in EMPTIED else case.expects
    if refusal not in ("learns", "survives"):
        with pytest.raises(InputError, match=refusal):
            trained(tmp_path / "run", scene, item_device, **options)
        return
    run = trained(tmp_path / "run", scene, item_device, **options)
    losses = [record["loss"] for record in records(run, "step")]
    assert losses and None not in losses  # null: not finite
    arrays, _ = run.load_checkpoint()
    for field, values in arrays.items():
        assert np.isfinite(values).all(), f"{field}: {np.sum(~np.isfinite(values))} not finite"
    read_ply(run.path / "point_cloud.ply")  # refuses what is not finite
    said = [record["text"] for record in records(run, "warning")]
    assert len(said) == len(case.warns) and all(map(str.__contains__, said, case.warns)), said
    if case.expects == "learns":
        assert losses[-1] < case.falls_to * losses[0], losses


@pytest.mark.parametrize("name", [name for name in CASES if CASES[name].warns])
def test_what_cannot_be_good_is_said(city, tmp_path, name):
    case = CASES[name]
    scene, options = prepared(city, case, "constant", tmp_path)
    options = options_of(**options)
    scene = scene.reduced(options.downscale)
    said = list(find_warnings(scene, Thumbnails(scene.split(options.test_every)[0]),
                              initial_gaussians(scene, options).count))
    assert len(said) == len(case.warns), said
    for text, part in zip(said, case.warns):
        assert part in text and "\n" not in text and len(text) < 160


# --- units and places


@pytest.mark.parametrize("factor", [1e-9, 1000.0])
def test_a_normalised_scene_is_the_same_in_any_unit(city, factor):
    one, other = city.normalised(), rescaled(city, factor).normalised()
    assert one.extent == pytest.approx(1)
    assert other.unit == pytest.approx(factor * one.unit) and one.unit == city.extent
    assert np.array_equal(one.points.astype(np.float32), other.points.astype(np.float32))
    assert np.allclose(one.offset + one.unit * one.points, city.offset + city.points)
    for a, b in zip(one.views, other.views):
        assert np.array_equal(a.camera.translation.astype(np.float32),
                              b.camera.translation.astype(np.float32))
    pixels, depths = city.views[3].camera.project(city.points)
    same, shallower = one.views[3].camera.project(one.points)
    assert np.allclose(same, pixels) and np.allclose(shallower * one.unit, depths)


def test_gaussians_in_other_units(city, tmp_path):
    """Those of a file begin where the scene's own do, whatever unit the scene is in."""
    options = options_of(schedule="sig", sphere=True, levels=(1.0,), sh_degree=0)
    given = initial_gaussians(city, options)
    write_ply(tmp_path / "a.ply", given, city.offset, sphere=True)
    scene = city.normalised()
    begun = initial_gaussians(scene, replace(options, init=str(tmp_path / "a.ply")))
    own = initial_gaussians(scene, options)
    assert set(begun.rows) == set(own.rows) and "anchors" in own.rows
    for name, values in own.rows.items():
        assert np.allclose(begun.rows[name], values, rtol=1e-5, atol=1e-6), name
        assert np.allclose(own.scaled(scene.unit).rows[name], given.rows[name], rtol=1e-5,
                           atol=1e-5), name


# --- what one bad point or camera must not decide
