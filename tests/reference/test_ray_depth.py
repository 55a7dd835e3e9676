"""The reference of depths along rays: a disc is a plane, a ball has the depth of its centre."""

import numpy as np
import pytest

from tests.reference.ray_depth import ray_depth

SIZE = 40, 30


def camera(orthographic=False):
    return {
        "width": SIZE[0],
        "height": SIZE[1],
        "fx": 200.0,
        "fy": 200.0,
        "cx": 20.0,
        "cy": 15.0,
        "rotation": np.eye(3),
        "translation": np.zeros(3),
        "orthographic": orthographic,
    }


def one(scales, quaternion=(1.0, 0, 0, 0)):
    return {
        "positions": np.array([[0.0, 0, 5]]),
        "log_scales": np.log([scales]),
        "quaternions": np.array([quaternion]),
        "opacity_logits": np.zeros(1),
        "sh_constant": np.zeros((1, 3)),
        "sh_rest": np.zeros((1, 0, 3)),
    }


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("degrees", [20.0, 60.0])
def test_a_disc_is_its_plane(orthographic, degrees):
    """Turned about x: the plane z = 5 + y tan."""
    half = np.radians(degrees) / 2
    rows = one([1, 1, 1e-4], (np.cos(half), np.sin(half), 0, 0))
    found = ray_depth(rows, camera(orthographic), np.ones(SIZE[::-1], int), 0.01, low_pass=1e-9)
    slope = np.tan(2 * half)
    across = (np.arange(SIZE[1]) + 0.5 - 15) / 200
    truth = 5 + across * slope if orthographic else 5 / (1 - across * slope)
    error = np.abs(found - truth[:, None]) / 5
    assert error.max() < (1e-6 if orthographic else 0.03) < 0.05 < np.ptp(truth) / 0.5
    assert error[14:16].max() < 1e-4  # beside the middle, where the tangent is the surface


def test_a_ball_a_needle_along_the_axis_and_no_gaussian():
    numbers = np.ones(SIZE[::-1], int)
    numbers[3, 4] = 0
    for scales in ([0.5] * 3, [1e-3, 1e-3, 0.5]):
        found = ray_depth(one(scales), camera(), numbers, 0.01)
        assert found[3, 4] == 0 and np.abs(found[15, 20] - 5) < 0.01
    ball = ray_depth(one([0.5] * 3), camera(True), np.ones_like(numbers), 0.01)
    assert np.abs(ball - 5).max() < 1e-9


def test_the_near_plane_is_a_limit():
    rows = one([40, 40, 1e-3], (np.cos(0.7), np.sin(0.7), 0, 0))
    found = ray_depth(rows, camera(), np.ones(SIZE[::-1], int), 4.9)
    assert found.min() == 4.9 < found.max()
