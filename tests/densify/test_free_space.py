"""The space in front of cameras that is free, by cameras and points made by hand."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.densify.free_space import FreeSpace
from clsplat.scene import Scene, View

HEIGHT = 10.0  # of the camera above the points
SHARE = 0.5


def scene_of(points, *cameras):
    return Scene("made", tuple(View(f"{i}.png", camera, b"") for i, camera in enumerate(cameras)),
                 points, np.zeros((len(points), 3), np.uint8))


def ground(count=400):
    """Points at height 0, all of which a camera above the origin shows."""
    rng = np.random.default_rng(0)
    return np.column_stack([rng.uniform(-2, 2, (count, 2)), np.zeros(count)])


CAMERA = Camera.looking_at((0, 0, 0), (0, 0, HEIGHT), up=(0, 1, 0), degrees=60)  # 640 x 480
ABOVE, BELOW = (np.array([[0, 0, HEIGHT * (1 - share * SHARE)]]) for share in (0.9, 1.1))


@pytest.mark.parametrize("position, held", [
    (ABOVE, True), (BELOW, False),
    ((0, 0, 0), False),
    ((0, 0, HEIGHT + 1), False),  # behind the camera
    ((3, 0, HEIGHT / 2 + 1), False),  # beside what it shows, at depth 4: 2.3 to each side
    ((2.2, 0, HEIGHT / 2 + 1), True),
    ((0, 2.2, HEIGHT / 2 + 1), False),  # the photo is less high than wide
    ((2.6, 1.9, HEIGHT - 4.8), True)])  # in a corner, farther from the camera than it is deep
def test_it_is_what_a_photo_shows_nearer_than_its_points(position, held):
    space = FreeSpace(scene := scene_of(ground(), CAMERA), scene.views, SHARE)
    assert space.holds(np.reshape(position, (1, 3)).astype(np.float32)).tolist() == [held]


def test_one_wrong_point_does_not_make_it_smaller_but_a_tower_does():
    wrong = np.vstack([ground(), [[0, 0, HEIGHT - 1]]])
    tower = np.vstack([ground(), np.tile([[0, 0, HEIGHT - 1.0]], (20, 1))])
    held = [FreeSpace(scene, scene.views, SHARE).holds(ABOVE)[0]
            for scene in (scene_of(points, CAMERA) for points in (wrong, tower))]
    assert held == [True, False]


def test_any_of_several_photos_is_enough():
    away = Camera.looking_at((100, 0, 0), (100, 0, HEIGHT), up=(0, 1, 0))
    points = np.vstack([ground(), ground() + [100, 0, 0]])
    scene = scene_of(points, CAMERA, away)
    places = np.vstack([ABOVE, BELOW, ABOVE + [100, 0, 0], ABOVE + [50, 0, 0]])
    held = [FreeSpace(scene, views, SHARE).holds(places).tolist()
            for views in (scene.views, scene.views[1:])]
    assert held == [[True, False, True, False], [False, False, True, False]]


def test_a_window_counts_with_its_whole_photo():
    window = CAMERA.cropped(0, 0, 64, 64)
    assert window.whole is not None
    scene = scene_of(ground(), CAMERA)
    views = [replace(scene.views[0], camera=window)]
    assert FreeSpace(scene, views, SHARE).holds(np.vstack([ABOVE, BELOW])).tolist() == [True, False]


@pytest.mark.parametrize("behind, views", [(2 * HEIGHT, 1), (0, 0)])
def test_without_points_or_views_nothing_is_free(behind, views):
    scene = scene_of(ground() + [0, 0, behind], CAMERA)
    assert not FreeSpace(scene, scene.views[:views], SHARE).holds(np.vstack([ABOVE, BELOW])).any()
