"""From where a viewer first looks."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.georeference import Georeference
from clsplat.placement.first_view import first_view
from tests.data.fields import field

UP = np.array([0.0, 0.0, 1.0])


def aerial(seed=0, pitch=90.0):
    """A flat field of 100 x 60, and cameras 80 above it."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((-50, -30, 0), (50, 30, 4), (2000, 3))
    back = 80 / np.tan(np.radians(pitch))
    targets = rng.uniform((-50, -30, 0), (50, 30, 0), (30, 3))
    cameras = [Camera.looking_at(target, target + [0, -back, 80], up=(0, 1, 0)) for target in targets]
    return cameras, points


@pytest.mark.parametrize("pitch", [90, 60, 30])
def test_an_aerial_scene_is_shown_whole_from_obliquely_above(pitch):
    cameras, points = aerial(pitch=pitch)
    view = first_view(cameras, points, UP)
    pixels, depths = view.project(points)
    inside = (depths > 0) & (pixels > 0).all(axis=1) & (pixels < (1280, 720)).all(axis=1)
    assert 0.9 < inside.mean() and np.ptp(pixels[:, 0]) > 0.6 * 1280
    steepness = np.degrees(np.arcsin(-view.rotation[2] @ UP))
    assert 30 <= steepness <= 65
    assert abs(view.rotation[0] @ UP) < 1e-9 and view.rotation[1] @ UP < 0  # upright
    assert abs(view.rotation[0, 0]) > 0.95  # the longer side lies across the image
    if pitch < 90:
        assert view.rotation[2, 1] > 0  # as the photos look


def test_north_is_upwards_where_it_is_known():
    cameras, points = aerial()
    view = first_view(cameras, points[:, [1, 0, 2]], UP, np.array([0.0, 1.0, 0.0]))
    assert view.rotation[2, 1] > 0 and abs(view.rotation[2, 0]) < 1e-9


def test_a_street_is_shown_as_a_photo_in_its_middle_shows_it():
    points = np.random.default_rng(0).uniform((-100, -8, 0), (100, 8, 6), (2000, 3))
    cameras = [Camera.looking_at((x + 10, 0, 1.7), (x, 0, 1.7)) for x in range(-90, 91, 10)]
    view = first_view(cameras, points, UP)
    assert any(view is camera for camera in cameras) and abs(view.position[0]) <= 50


def test_a_scene_has_its_first_view_in_original_coordinates():
    scene = field()
    assert abs(scene.up[2]) > 0.99
    moved = replace(scene, georeference=Georeference("EPSG:32614", (5e5, 3e6, 0), "test", 0.1))
    assert moved.up.tolist() == [0, 0, 1]
    view = moved.recentred().first_view
    assert np.allclose(view.position + view.offset, moved.first_view.position + moved.offset)
    assert moved.normalised().with_up([0, 2, 0]).up.tolist() == [0, 1, 0]
    for wrong in ([0, 0, 0], [0, 0, np.nan], [1, 2]):
        with pytest.raises(InputError, match="is no direction; give one such as 0 0 1"):
            scene.with_up(wrong)
    assert scene.part(range(5)).up.tolist() == scene.up.tolist()
