"""How much photos disagree about the colours of a scene."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.covisibility.photometry import colour_disagreement
from clsplat.training import photos
from clsplat.training.photos import Thumbnails
from clsplat.training.start import prepare as module
from tests.covisibility.test_source_views import circle

SIDE = 512


def photos_of(scene, noise=0.0, gains=None, strange=0.0):
    """Photos in which each point has its colour, with normal noise, a factor and an offset a photo;
    a share `strange` of the points has another colour in each photo."""
    rng = np.random.default_rng(0)
    colours = rng.uniform(0.2, 0.7, (len(scene.points), 3))
    photos = []
    for number, view in enumerate(scene.views):
        photo = rng.integers(0, 256, (3, SIDE, SIDE), np.uint8)
        column, row = view.camera.resized(SIDE, SIDE).project(scene.points)[0].astype(int).T
        seen = colours + rng.normal(0, 1, colours.shape) * noise
        if gains:
            seen = seen * gains[number] + 0.02 * number
        other = rng.random(len(seen)) < strange
        seen = np.where(other[:, None], rng.uniform(0, 1, seen.shape), seen)
        photo[:, row, column] = (255 * seen.clip(0, 1)).round().T
        photos.append(photo)
    return photos


@pytest.fixture(scope="module")
def scene():
    scene = circle(*range(0, 24, 4), points=300)
    cloud = np.random.default_rng(1).uniform(-2.5, 2.5, (300, 3))
    return replace(scene, points=cloud)


def found(scene, photos, **changes):
    scene = replace(scene, **changes)
    return colour_disagreement(scene, scene.views, photos)


@pytest.mark.parametrize("noise", [0.02, 0.05])
def test_the_deviation_of_noise_is_found_whatever_the_exposures(scene, noise):
    for gains in (None, [1, 0.8, 1.1, 0.9, 1, 0.7]):
        assert found(scene, photos_of(scene, noise, gains)) == pytest.approx(noise, rel=0.15)


def test_photos_that_agree_and_wrong_observations(scene):
    assert found(scene, photos_of(scene)) < 0.004
    assert found(scene, photos_of(scene, 0.03, strange=0.03)) == pytest.approx(0.03, rel=0.4)
    rest = scene.observations[scene.observations[:, 0] % 2 == 0]  # of the others nothing is known
    half = photos_of(scene, 0.02)
    for photo, view in zip(half, scene.views):
        column, row = view.camera.resized(SIDE, SIDE).project(scene.points[1::2])[0].astype(int).T
        photo[:, row, column] = 0
    assert found(scene, half, observations=rest) == pytest.approx(0.02, rel=0.2)


def test_where_nothing_is_known(scene):
    photos = photos_of(scene, 0.02)
    few = scene.observations[scene.observations[:, 1] < 2]
    for observations in (None, few, few[:0], scene.observations[: 9 * len(photos)]):
        assert np.isnan(found(scene, photos, observations=observations))
    masked = [np.concatenate([photo, np.zeros((1, SIDE, SIDE), np.uint8)]) for photo in photos]
    assert np.isnan(found(scene, masked))


@pytest.fixture
def read(monkeypatch):
    """The names of the photos that were read; there are none."""
    names = []
    monkeypatch.setattr(photos, "decoded", lambda views: [names.append(view.name) or view.name for view in views])
    return names


def test_photos_are_sampled_in_runs_that_show_the_same_places(monkeypatch, read):
    chosen = []
    monkeypatch.setattr(module, "colour_disagreement", lambda scene, views, photos: chosen.extend(views) or 0.01)
    many = circle(*range(100), names=[f"{number:03d}" for number in range(100)])
    assert module._disagreement(many, Thumbnails(many.views)) == 0.01
    numbers = np.array([int(view.name) for view in chosen])
    assert len(numbers) == 48 == len(set(numbers)) and {numbers[0], numbers[-1]} == {0, 99}
    assert (np.diff(numbers) == 1).sum() == 44
    chosen.clear()
    module._disagreement(many, Thumbnails(many.views[:48]))
    assert [view.name for view in chosen] == [view.name for view in many.views[:48]]


def test_how_many_photos_show_a_point():
    """Points that one photo shows tell nothing, and are not counted."""
    scene = circle(0, 5, 10, 15)
    pairs = [(0, 0), (0, 1), (0, 2), (0, 3), (1, 1), (1, 2), (2, 3)]
    scene = replace(scene, observations=np.array(pairs))
    assert module.scene_facts(scene, scene.views).shown_in == 3.0
    assert module.scene_facts(scene, scene.views[:2]).shown_in == 2.0
    assert np.isnan(module.scene_facts(scene, scene.views[:1]).shown_in)
    unknown = replace(scene, observations=None)
    assert np.isnan(module.scene_facts(unknown, unknown.views).shown_in)
