"""Source views: those that share enough points with the reference view at a good angle."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.covisibility.source_views import choose_source_views
from clsplat.scene import Scene, View


def circle(*degrees, points=40, names=None):
    """Views on a circle around a small cloud at the origin, each seeing all of it."""
    views = []
    for number, angle in enumerate(np.deg2rad(degrees)):
        forward = np.array([np.cos(angle), np.sin(angle), 0])
        rotation = np.stack([np.cross(forward, [0, 0, 1]), [0, 0, -1], forward])
        camera = Camera(64, 48, (60.0, 60.0), (32.0, 24.0), rotation, np.array([0, 0, 10.0]))
        views.append(View(names[number] if names else f"{number:02d}", camera, b""))
    cloud = np.random.default_rng(0).normal(0, 0.01, (points, 3))
    seen = np.stack(np.divmod(np.arange(points * len(views)), len(views)), axis=1)
    return Scene("circle", tuple(views), cloud, np.zeros((points, 3), np.uint8), observations=seen.astype(np.int32))


def chosen(scene, *arguments):
    return [sources.tolist() for sources in choose_source_views(scene, scene.views, *arguments)]


@pytest.mark.parametrize("tracks", [True, False])
def test_an_angle_of_ten_degrees_is_best(tracks):
    scene = circle(0, 2, 10, 19, 45, 81)
    if not tracks:
        scene = replace(scene, observations=None)
    assert chosen(scene, 9) == [
        [2, 3, 4, 1],
        [2, 3, 4, 0],
        [0, 3, 1, 4],
        [2, 1, 0, 4],
        [3, 2, 5, 1, 0],
        [4],
    ]  # more than 60 degrees do not count
    assert chosen(scene)[0] == [2, 3, 4]
    assert chosen(scene, 1)[4] == [3]


def test_the_weight_falls_alike_for_half_and_twice_the_angle():
    scene = circle(0, 5, -20)
    scene = replace(scene, observations=scene.observations[:-1])  # the last sees one point less
    assert chosen(scene)[0] == [1, 2]
    assert chosen(circle(0, 5.2, -20))[0] == [1, 2]
    assert chosen(circle(0, 4.8, -20))[0] == [2, 1]


def test_many_shared_points_outweigh_a_better_angle():
    scene = circle(0, 5, 10)
    few = scene.observations[(scene.observations[:, 1] < 2) | (scene.observations[:, 0] < 21)]
    assert chosen(replace(scene, observations=few))[0] == [1, 2]
    assert chosen(scene)[0] == [2, 1]


def test_cameras_at_one_place_or_at_large_angles_are_not_source_views():
    assert chosen(circle(0, 0, 0.5, 90)) == [[], [], [], []]


@pytest.mark.parametrize("points, expected", [(19, [[], []]), (20, [[1], [0]])])
def test_twenty_shared_points_are_needed(points, expected):
    assert chosen(circle(0, 10, points=points)) == expected


def test_projected_points_lie_in_front_of_the_camera_and_in_the_image():
    scene = replace(circle(0, 10, 20), observations=None)
    camera = scene.views[1].camera
    back = np.diag([-1, 1, -1])
    for turned in (
        replace(camera, rotation=back @ camera.rotation, translation=back @ camera.translation),
        replace(camera, centre=(-1.0, 24.0)),
        replace(camera, centre=(32.0, 49.0)),
    ):
        views = (scene.views[0], replace(scene.views[1], camera=turned), scene.views[2])
        assert [s.tolist() for s in choose_source_views(scene, views)] == [[2], [], [0]]
