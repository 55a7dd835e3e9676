"""Responses of held-out photos follow from those of the training photos around them."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.evaluation.held_out_responses import _interpolated, _weight, predicted_responses
from clsplat.response import Response
from clsplat.scene import View

CAMERA = Camera(60, 40, (50, 50), (30, 20), np.eye(3), np.zeros(3))


def view(name):
    return View(name, CAMERA, b"")


def transforms_of(gains):
    return np.array([np.eye(3, 4) * gain for gain in gains])


def learned(gains, lens=(0, 0, 0, 1)):
    """Responses by name, photo_0 on, without each third from the second on."""
    return {
        f"photo_{i}.jpg": Response(np.eye(3, 4) * gain, np.array(lens, float))
        for i, gain in enumerate(gains)
        if i % 3 != 1
    }


def test_a_slow_change_is_interpolated_in_the_order_of_numbers():
    gains = 1 + 0.2 * np.sin(np.arange(30) / 6)
    known = learned(gains)
    found = predicted_responses([view(f"photo_{i}.jpg") for i in range(30)], known)
    assert found.weight > 0.95 and found.responses.keys() > known.keys()
    for i in (4, 10, 19):  # photo_10 stands between photo_9 and photo_11
        assert found.responses[f"photo_{i}.jpg"].transform == pytest.approx(np.eye(3, 4) * gains[i], abs=0.01)
    assert all(found.responses[name] is response for name, response in known.items())


def test_where_neighbours_tell_nothing_the_mean_does():
    gains = 1 + 0.2 * (-1.0) ** (np.arange(30) // 3)  # neighbours differ
    known = learned(gains)
    found = predicted_responses([view(f"photo_{i}.jpg") for i in range(30)], known)
    mean = np.mean([response.transform for response in known.values()], axis=0)
    assert found.weight < 0.5
    alone = np.random.default_rng(0).normal(1, 0.1, 200)
    assert _weight(np.arange(200), transforms_of(alone)) < 0.2
    assert np.abs(found.responses["photo_1.jpg"].transform - mean).max() < 0.15


def test_between_two_places_and_at_the_ends():
    places, known = np.array([2, 4, 8]), transforms_of([1, 2, 4])
    for place, gain in ((0, 1), (2, 1), (3, 1.5), (5, 2.5), (7, 3.5), (9, 4)):
        assert np.allclose(_interpolated(place, places, known), np.eye(3, 4) * gain), place


@pytest.mark.parametrize("gains", [[1.1], [1.1, 0.9], [1.0, 1.0, 1.0, 1.0]])
def test_few_or_equal_photos_leave_the_mean(gains):
    assert _weight(np.arange(len(gains)), transforms_of(gains)) == 0


def test_a_lens_is_that_of_training_photos_of_its_shape():
    lens = (-0.2, 0.1, 0, 1.5)
    views = [view(f"photo_{i}.jpg") for i in range(6)]
    views[4] = replace(views[4], camera=CAMERA.resized(60, 90))
    found = predicted_responses(views, learned(np.ones(6), lens)).responses
    assert found["photo_1.jpg"].vignetting.tolist() == list(lens)
    assert not found["photo_4.jpg"].has_vignetting


def test_without_learned_responses_there_are_none():
    assert predicted_responses([view("a"), view("b")], None) is None
    assert predicted_responses([view("a"), view("b")], {}) is None
    assert predicted_responses([view("a")], {"b": Response()}) is None
