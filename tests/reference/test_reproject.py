"""The reference reprojection: against finite differences and against values computed by hand."""

import numpy as np
import pytest

from tests.checks import adjoint_agrees
from tests.data.view_pairs import IDENTITY, view_pair
from tests.reference.reproject import fragile_pixels, reproject

COLOUR = np.array([[0.9, 0.1, -0.05, 0.02], [0.0, 1.1, 0.05, -0.03], [0.1, 0.0, 0.8, 0.01]])


@pytest.mark.parametrize("size, other_size", [((30, 20), (41, 27)), ((17, 23), (16, 9))])
@pytest.mark.parametrize("seed", range(3))
def test_adjoint_agrees_with_differences(size, other_size, seed):
    cameras, photo, neighbour, z = view_pair(size, other_size, seed)
    rng = np.random.default_rng(seed)
    transmittance = rng.uniform(0, 0.7, z.shape)
    depth = z * rng.uniform(0.8, 1.2, z.shape) * (1 - transmittance)
    transmittance[fragile_pixels(depth, transmittance, neighbour, cameras)] = 1

    def back(point):
        return reproject(point["depth"], point["transmittance"], photo / 255, neighbour / 255, cameras, COLOUR)

    def function(point):
        squares, valid, _, _ = back(point)
        return {"value": squares.sum() / valid.sum()}

    def adjoint(point, grads):
        return dict(zip(("depth", "transmittance"), grads["value"] * np.array(back(point)[2:])))

    point = {"depth": depth, "transmittance": transmittance}
    assert 0.2 < back(point)[1].mean() < 0.8
    adjoint_agrees(function, adjoint, point, seed, what=f"reproject {size}")


def side_by_side(move):
    """Two cameras of 10 pixels focal length; what is at x for one is at x + move for the other."""
    camera = {
        "width": 9,
        "height": 3,
        "fx": 10.0,
        "fy": 10.0,
        "cx": 4.5,
        "cy": 1.5,
        "rotation": np.eye(3),
        "translation": np.zeros(3),
    }
    return camera, {**camera, "translation": np.array(move, float)}


def test_a_ramp_by_hand():
    """At depth 5 a move by 1 is one by 10 / 5 = 2 pixels, and -10 / 5^2 pixels a unit of depth."""
    ramp = np.tile(0.01 * np.arange(9.0), (3, 3, 1))
    transmittance = np.full((3, 9), 0.2)
    squares, valid, by_depth, by_transmittance = reproject(
        np.full((3, 9), 5 * 0.8), transmittance, ramp, ramp, side_by_side([1, 0, 0]), IDENTITY
    )
    expected = np.zeros((3, 9), bool)
    expected[:2, :6] = True  # the last line and, two further, the last column have no next texel
    np.testing.assert_array_equal(valid, expected)
    np.testing.assert_allclose(squares[valid], 3 * 0.02**2)
    by_z = 3 * 2 * 0.02 * 0.01 * -0.4 / 12
    np.testing.assert_allclose(by_depth, by_z / 0.8 * expected)
    np.testing.assert_allclose(by_transmittance, by_z * 5 / 0.8 * expected)


def test_colours_are_transformed_before_they_are_compared():
    dark = np.full((3, 3, 9), 0.25)
    colour = np.array([[2, 0, 0, 0.1], [0, 1, 0, 0], [1, 1, 1, 0]])
    squares, valid, _, _ = reproject(
        np.full((3, 9), 5.0), np.zeros((3, 9)), dark, dark, side_by_side([0, 0, 0]), colour
    )
    np.testing.assert_allclose(squares[valid], 0.35**2 + 0.5**2)


@pytest.mark.parametrize(
    "depth, transmittance, move, valid",
    [
        (4.0, 0.0, 0, True),
        (4.0, 0.49, 0, True),
        (4.0, 0.5, 0, False),
        (4.0, 1.0, 0, False),
        (0.0, 0.0, 0, False),
        (-4.0, 0.0, 0, False),
        (np.nan, 0.0, 0, False),
        (np.inf, 0.0, 0, False),
        (4.0, np.nan, 0, False),
        (4.0, 0.0, -3.5, True),
        (4.0, 0.0, -3.7, False),
        (4.0, 0.0, -4.5, False),
        (4.0, 0.0, 1e3, True),
    ],
)
def test_which_pixels_are_valid(depth, transmittance, move, valid):
    """By the pixel in the middle, which every move along the axis leaves there."""
    black = np.zeros((3, 3, 9))
    depths, transmittances = np.full((3, 9), depth), np.full((3, 9), transmittance)
    with np.errstate(invalid="ignore"):
        _, found, *grads = reproject(depths, transmittances, black, black, side_by_side([0, 0, move]), IDENTITY)
    assert found[1, 4] == valid and np.isfinite(grads).all()


def test_fragile_pixels_are_those_at_a_threshold():
    photo = np.zeros((3, 3, 9))

    def fragile(depth, transmittance, move):
        return fragile_pixels(
            np.full((3, 9), depth) * (1 - transmittance), np.full((3, 9), transmittance), photo, side_by_side(move)
        )[1, 4]

    assert not fragile(4.0, 0.2, [0.1, 0.1, 0])
    assert fragile(4.0, 0.50001, [0.1, 0.1, 0])
    assert fragile(4.0, 0.2, [0.4, 0.1, 0]) and fragile(4.0, 0.2, [0.1, 0.0, 0])
    assert fragile(4.0, 0.2, [0.01, 0.01, -3.6])
