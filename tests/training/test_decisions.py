"""What a scene needs of what is optional: found out, said why, refused where it cannot be met."""

import math
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from clsplat.covisibility.photometry import DARKENS, DRIFTS
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.io.models.ply import write_ply
from clsplat.io.scenes.read import read_scene
from clsplat.options import resolve
from clsplat.schedule.sig import AGREEING, ENOUGH, FEWEST
from clsplat.schedule.steps import planned_steps, scaled_steps
from clsplat.training import photos
from clsplat.training.part import Survey
from clsplat.training.parts import exposures
from clsplat.training.parts.exposures import SAMPLED_PHOTOS
from clsplat.training.photos import SMALL_SIDE, Thumbnails
from clsplat.training.start import prepare as module
from clsplat.training.start.prepare import find_decisions, smallest_size
from tests.data.tiny_training import CITY


@pytest.fixture(scope="module")
def city():
    return read_scene(CITY).reduced(4)


@pytest.fixture(scope="module", autouse=True)
def decoded_once():
    """Each photo at each size, for all these tests."""
    known, decode = {}, photos.decode

    def of(view):
        key = view.source, view.camera.width, view.camera.height
        if key not in known:
            known[key] = decode(view)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(photos, "decode", of)
        yield


def survey_of(scene, options):
    return Survey(scene, scene.views, options, Thumbnails(scene.views))


def found(scene, **options):
    return find_decisions(survey_of(scene, resolve({}, options)))


@pytest.fixture
def drift(monkeypatch):
    """Sets the drift that is measured; returns what it was measured on. Other photos are not read."""
    seen = []

    def set_to(value):
        def measure(views, photos, points, colours):
            seen.append((views, photos, points))
            return value

        monkeypatch.setattr(exposures, "exposure_drift", measure)
        monkeypatch.setattr(module, "colour_disagreement", lambda *_: math.nan)
        return seen

    return set_to


def test_nothing_is_left_open(city, drift):
    drift(0.0)
    for schedule in ("sig", "constant", "dash"):
        options = found(city, schedule=schedule).options
        assert options.exposure in ("on", "off") and options.reproject in ("on", "off")
        assert options.vignetting in ("on", "off")
        assert options.init == ("dense" if schedule == "sig" else "sfm")
        unchanged = {"exposure": "off", "vignetting": "off", "reproject": "off", "init": "sfm"}
        # the city has 32 photos, which allow fewer steps in sig
        steps = ENOUGH if schedule == "sig" else 9600
        chosen = scaled_steps(resolve({}, {"schedule": schedule, "iterations": steps}))
        assert replace(options, **unchanged) == replace(chosen, **unchanged)


@pytest.mark.parametrize("photos, steps", [(2, 7000), (32, 9600), (99, 29_700), (5000, 30_000)])
def test_the_number_of_steps_follows_the_photos(photos, steps):
    assert planned_steps(resolve({}, {}), photos)[0] == steps
    assert planned_steps(resolve({}, {"iterations": 60}), photos) == (60, "60: requested")
    assert planned_steps(resolve({}, {"preset": "paper"}), photos)[0] == 30_000


@pytest.mark.one_in(9)
@pytest.mark.parametrize(
    "photos, differ, most",
    [
        (32, 0.0, ENOUGH),
        (32, AGREEING, ENOUGH),
        (32, math.nan, ENOUGH),
        (32, 0.05, 1600),
        (32, 0.2, 1600),
        (12, 0.2, FEWEST),
        (100, 0.0, 7500),
        (40, 0.04, 2551),
        (100, 0.2, 5000),
    ],
)
def test_more_steps_than_the_photos_allow_are_not_taken(city, drift, monkeypatch, photos, differ, most):
    drift(0.0)
    monkeypatch.setattr(module, "colour_disagreement", lambda *_: differ)
    city = replace(city, views=(4 * city.views)[:photos], observations=None)
    decided = partial(found, city, init="sfm")  # no photos are compared for dense points
    result = decided()
    assert result.options.iterations == result.most_steps == most
    assert result.reasons["steps"].startswith(f"{most:,}: the most for {photos} ")
    assert result.reasons["steps"].endswith(" would over-fit them")
    assert decided(iterations=900).reasons["steps"] == "900: requested"
    tenth = decided(steps_scale=0.1)
    assert tenth.options.iterations == tenth.most_steps == round(most / 10)
    budget = decided(time_budget="1h")
    assert budget.options.iterations == budget.most_steps == most
    assert decided(iterations=30_000, visits=100.0).options.iterations == 100 * photos
    for every in ({}, {"visits": 0.0}, {"coarse": True}, {"schedule": "constant"}, {"schedule": "mcmc"}):
        assert decided(iterations=30_000, **every).options.iterations == 30_000
    assert resolve({}, {"preset": "paper"}).visits == resolve({}, {"preset": "release"}).visits == 0


@pytest.mark.parametrize("measured, answer", [(DRIFTS, "on"), (0.99 * DRIFTS, "off"), (0, "off")])
def test_exposures_are_learned_where_photos_drift(city, drift, measured, answer):
    drift(measured)
    result = found(city, exposure="auto")
    assert result.options.exposure == answer
    reason = result.reasons["exposure"]
    assert reason.startswith(f"{answer}: ") and f"{100 * measured:.1f} %" in reason
    assert "32 photos" in reason


def test_the_city_does_not_drift_until_its_photos_are_darkened(city, monkeypatch):
    assert found(city).options.exposure == "off"
    read = photos.decoded
    monkeypatch.setattr(
        photos,
        "decoded",
        lambda views: ((photo * (0.6 if i % 2 else 1)).astype(np.uint8) for i, photo in enumerate(read(views))),
    )
    assert found(city).options.exposure == "on"


@pytest.mark.parametrize("answer", ["on", "off"])
def test_what_is_asked_for_is_not_measured(city, drift, answer):
    seen = drift(1.0)
    result = found(city, exposure=answer)
    assert (result.options.exposure, seen) == (answer, [])
    assert result.reasons["exposure"] == f"{answer}: requested"


@pytest.mark.parametrize("measured, answer", [(DARKENS, "on"), (0.99 * DARKENS, "off"), (-1, "off")])
def test_vignetting_is_learned_with_exposures_where_corners_are_darker(city, monkeypatch, measured, answer):
    monkeypatch.setattr(exposures, "corner_darkening", lambda *_: measured)
    result = found(city, exposure="on", vignetting="auto")
    assert result.options.vignetting == answer
    assert result.reasons["vignetting"].startswith(f"{answer}: the corners of 32 photos are ")
    assert found(city, exposure="on").options.vignetting == "off"
    without = found(city, exposure="off", vignetting="auto")
    assert without.options.vignetting == "off" and "not learned" in without.reasons["vignetting"]
    for asked in ("on", "off"):
        assert found(city, exposure="on", vignetting=asked).options.vignetting == asked
    with pytest.raises(InputError, match="--exposure on"):
        found(city, exposure="off", vignetting="on")


def test_few_small_photos_stand_for_all(city, drift):
    seen = drift(0.0)
    large = replace(city.views[0], camera=city.views[0].camera.resized(4 * SMALL_SIDE, 100))
    many = replace(city, views=(large, *city.views * 5))
    find_decisions(survey_of(many, resolve({}, {"reproject": "off"})))
    ((views, _, points),) = seen
    assert 0.5 * SAMPLED_PHOTOS <= len(views) <= SAMPLED_PHOTOS and points is many.points
    assert [view.name for view in views] == [view.name for view in many.views[::3]]
    assert max(max(v.camera.width, v.camera.height) for v in views) <= SMALL_SIDE


@pytest.mark.parametrize("asked", ["auto", "on"])
def test_adjacent_photos_are_found(city, drift, asked):
    drift(0.0)
    result = found(city, reproject=asked)
    sources = result.parts["reproject"].found
    assert result.options.reproject == "on" and len(sources) == len(city.views)
    assert all(number not in adjacent for number, adjacent in enumerate(sources))
    assert result.reasons["reproject"] == "on: 32 of 32 photos have an adjacent one"


def test_photos_that_share_nothing(city, drift):
    drift(0.0)
    apart = replace(city, observations=city.observations[:0])
    result = found(apart, reproject="auto")
    assert (result.options.reproject, result.parts["reproject"].found) == ("off", None)
    assert result.reasons["reproject"] == "off: no two photos share 20 sparse points"
    with pytest.raises(InputError, match="city: --reproject on needs .* use --reproject auto"):
        found(apart, reproject="on")


def test_the_shortest_side_counts(city):
    cameras = [city.views[0].camera.resized(*size) for size in ((90, 70), (300, 60), (61, 500))]
    views = [replace(city.views[0], camera=camera) for camera in cameras]
    assert smallest_size(views) == (300, 60)


def test_levels_are_named(city, drift):
    drift(0.0)
    large = replace(city, views=tuple(replace(view, camera=view.camera.resized(320, 240)) for view in city.views))
    dense = found(large, iterations=3000)
    assert dense.values["levels"] == (2.0, 1.0)
    assert "; dense points enter with them; sides" in dense.reasons["levels"]
    coarse = found(large, iterations=3000, init="dense", coarse=True)
    assert dense.facts.dense and not coarse.facts.dense
    result = found(large, iterations=3000, init="sfm")
    assert result.values["levels"] == (3.0, 2.0, 1.0)
    assert result.reasons["levels"] == (
        "3 2 1: 106 x 80 to 320 x 240 pixels; sides below 64, and levels shorter than 200 steps, are left out"
    )
    assert found(large, levels=(4.0, 1.0)).reasons["levels"] == ("4 1: requested; 80 x 60 to 320 x 240 pixels")
    assert found(large, schedule="constant").values["levels"] == (1.0,)


def test_moments_are_coded_by_the_gaussians_to_come(city, drift, monkeypatch, tmp_path):
    drift(0.0)
    options = resolve({}, {"schedule": "taming", "iterations": 7000})
    needed = 3 * 59 * 15 * 4400 * 4  # bytes, at the end

    def engine(memory, **changes):
        device = SimpleNamespace(real=np.dtype(np.float32), memory_limit=memory, limit_memory=lambda nbytes: None)
        return find_decisions(survey_of(city, replace(options, **changes)), device)

    assert engine(3.02 * needed).options.engine == "device"
    result = engine(2.98 * needed)
    assert result.options.engine == "coded" == result.values["engine"]
    assert "take up to 45 MiB, coded 26, of the device's 133" in result.reasons["engine"]
    assert engine(0.1 * needed).options.engine == "coded"  # harmonics then wait in host memory
    assert engine(2.98 * needed, sh_degree=2).options.engine == "device"
    assert engine(1.0, engine="device").reasons["engine"] == "device: requested"
    large = tmp_path / "large.ply"  # where training begins at a file, by the gaussians of that
    write_ply(large, Gaussians.from_points(*np.random.default_rng(1).random((2, 90_000, 3)), 0))
    of_file = 3 * 59 * 90_000 * 4
    started = {"schedule": "mcmc", "max_gaussians": 90_000, "init": str(large)}
    assert engine(3.02 * of_file, **started).options.engine == "device"
    assert engine(2.98 * of_file, **started).options.engine == "coded"
    assert find_decisions(survey_of(city, options)).options.engine == "auto"
    # dash, which looks at every photo when training begins, does not for this
    monkeypatch.setattr(module, "decoded", None)
    assert engine(1e9, schedule="dash").options.engine == "device"
