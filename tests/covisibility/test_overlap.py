"""How many views show a place."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.covisibility.overlap import mean_overlap
from clsplat.scene import View
from tests.covisibility.test_source_views import circle


def test_views_of_the_same_place():
    """However few of them observed a point."""
    scene = circle(0, 10, 20, 45)
    few = replace(scene, observations=scene.observations[::4])
    for each in (scene, few, replace(scene, observations=None)):
        assert mean_overlap(each, each.views) == pytest.approx(4)
        assert mean_overlap(each, each.views[:1]) == pytest.approx(1)


def test_half_of_the_pixels_show_what_another_view_shows():
    """The first view shows both clouds, which have as many points, the second one of them: its
    pixels and half of the first one's are seen twice."""
    scene = circle(0, 90)
    first, second = scene.views
    beside = scene.points + np.array([7.0, 0, 0])  # out of the second's image
    both = replace(scene, points=np.concatenate([scene.points, beside]), observations=None)
    assert not second.sees(beside).any() and first.sees(beside).all()
    assert mean_overlap(both, both.views) == pytest.approx(2 / (0.75 + 0.5))
    small = View(second.name, second.camera.resized(second.camera.width // 2,
                                                    second.camera.height // 2), b"")
    assert mean_overlap(both, (first, small)) == pytest.approx(1.25 / (0.75 + 0.125))


def test_where_nothing_is_known():
    scene = circle(0, 10)
    behind = replace(scene, points=scene.points - 1000.0, observations=None)
    assert np.isnan(mean_overlap(replace(scene, points=np.zeros((0, 3))), scene.views))
    assert np.isnan(mean_overlap(behind, scene.views))
    away = replace(scene.views[0], camera=replace(scene.views[0].camera, centre=(-1000.0, 24.0)))
    assert mean_overlap(scene, (*scene.views, away)) == pytest.approx(2), "it shows no point"
