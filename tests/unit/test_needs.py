"""What a scene needs of what is optional: found out, said why, refused where it cannot be met."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.drift import DRIFTS
from clsplat.errors import InputError
from clsplat.io.scenes import read_scene
from clsplat.options import resolve
from clsplat.train import needs
from clsplat.train.needs import LOOKED_AT, SMALL_SIDE, find_needs, smallest_size
from tests.tiny_training import CITY


@pytest.fixture(scope="module")
def city():
    return read_scene(CITY).reduced(4)


def found(scene, **options):
    return find_needs(scene, scene.views, resolve({}, options))


@pytest.fixture
def drift(monkeypatch):
    """Sets the drift that is measured; returns what it was measured on."""
    seen = []

    def set_to(value):
        def measure(views, photos, points, colours):
            seen.append((views, photos, points))
            return value
        monkeypatch.setattr(needs, "exposure_drift", measure)
        return seen
    return set_to


def test_nothing_is_left_open(city, drift):
    drift(0.0)
    for schedule in ("sig", "constant", "dash"):
        options = found(city, schedule=schedule).options
        assert options.exposure in ("on", "off") and options.reproject in ("on", "off")
        unchanged = {"exposure": "off", "reproject": "off"}
        assert replace(options, **unchanged) == replace(resolve({}, {"schedule": schedule}),
                                                        **unchanged)


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
    read = needs.decoded
    monkeypatch.setattr(needs, "decoded", lambda views: (
        (photo * (0.6 if i % 2 else 1)).astype(np.uint8) for i, photo in enumerate(read(views))))
    assert found(city).options.exposure == "on"


@pytest.mark.parametrize("answer", ["on", "off"])
def test_what_is_asked_for_is_not_measured(city, drift, answer):
    seen = drift(1.0)
    result = found(city, exposure=answer)
    assert (result.options.exposure, seen) == (answer, [])
    assert result.reasons["exposure"] == f"{answer}: asked for"


def test_few_small_photos_stand_for_all(city, drift):
    seen = drift(0.0)
    large = replace(city.views[0], camera=city.views[0].camera.resized(4 * SMALL_SIDE, 100))
    many = replace(city, views=(large, *city.views * 5))
    find_needs(many, many.views, resolve({}, {"reproject": "off"}))
    (views, _, points), = seen
    assert 0.5 * LOOKED_AT <= len(views) <= LOOKED_AT and points is many.points
    assert [view.name for view in views] == [view.name for view in many.views[::3]]
    assert max(max(v.camera.width, v.camera.height) for v in views) <= SMALL_SIDE


@pytest.mark.parametrize("asked", ["auto", "on"])
def test_adjacent_photos_are_found(city, drift, asked):
    drift(0.0)
    result = found(city, reproject=asked)
    assert result.options.reproject == "on" and len(result.neighbours) == len(city.views)
    assert all(number not in adjacent for number, adjacent in enumerate(result.neighbours))
    assert result.reasons["reproject"] == "on: 32 of 32 photos have an adjacent one"


@pytest.mark.parametrize("options", [
    {}, {"reproject": "auto", "reproject_weight": 0.0}, {"schedule": "taming"}], ids=str)
def test_adjacent_photos_are_not_looked_for(city, drift, monkeypatch, options):
    drift(0.0)
    monkeypatch.delattr(needs, "adjacent_views")
    result = found(city, **options)
    assert (result.options.reproject, result.neighbours) == ("off", None)
    assert result.reasons["reproject"] == "off: not asked for"


def test_photos_that_share_nothing(city, drift):
    drift(0.0)
    apart = replace(city, observations=city.observations[:0])
    result = found(apart, reproject="auto")
    assert (result.options.reproject, result.neighbours) == ("off", None)
    assert result.reasons["reproject"] == "off: no two photos share 20 sparse points"
    with pytest.raises(InputError, match="city: --reproject on needs .* use --reproject auto"):
        found(apart, reproject="on")


def test_the_shortest_side_counts(city):
    cameras = [city.views[0].camera.resized(*size) for size in ((90, 70), (300, 60), (61, 500))]
    views = [replace(city.views[0], camera=camera) for camera in cameras]
    assert smallest_size(views) == (300, 60)
