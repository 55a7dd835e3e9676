"""Which way is up, by cameras and points."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clsplat.placement.up import Vertical, gimbal_up
from tests.data.fields import field


def test_up_does_not_depend_on_points_far_away():
    rng = np.random.default_rng(0)
    rolled = Rotation.random(60, random_state=1).as_matrix()  # cameras that do not show up
    rolled[:, 2] = [0, 0, -1] + 0.01 * rng.normal(size=(60, 3))  # except by their viewing direction
    points = np.concatenate([field().points, [0, 300, 200] + rng.normal(0, 5, (100, 3))])
    assert Vertical.by_cameras(rolled, points).up[2] > 0.999


@pytest.mark.parametrize("pitch, roll", [(-90, 0), (-60, 0), (0, 0), (-45, 20), (10, -5)])
def test_gimbals_tell_gravity(pitch, roll):
    """A gimbal turns about the vertical, then its pitch axis, then its viewing direction."""
    rotations = []
    for yaw in (0, 70, 200):
        # body axes forward, right, down in the axes north, east, down
        body = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True).as_matrix()
        axes = body[:, [1, 2, 0]]  # right, down, forward
        rotations.append(axes.T)
    up = gimbal_up(np.array(rotations), np.full(3, pitch), np.full(3, roll))
    assert np.allclose(up, [0, 0, -1])


def test_gimbals_that_contradict_each_other_tell_nothing():
    rotations = Rotation.random(9, random_state=0).as_matrix()
    assert gimbal_up(rotations, np.zeros(9), np.zeros(9)) is None
