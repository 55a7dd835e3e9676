"""Cameras of smaller images and of parts of images show the same points in the same places."""

import numpy as np
import pytest

from clsplat.camera import Camera

CAMERA = Camera.looking_at((0, 0, 0), (1, 2, 3), width=64, height=48)
POINTS = np.random.default_rng(0).uniform(-0.5, 0.5, (9, 3))


@pytest.mark.parametrize(
    "camera, scale, shift",
    [
        (CAMERA.resized(32, 12), (0.5, 0.25), (0, 0)),
        (CAMERA.cropped(10, 4, 50, 40), (1, 1), (10, 4)),
        (CAMERA.cropped(10, 4, 50, 40).resized(20, 18), (0.5, 0.5), (10, 4)),
        (CAMERA.reduced(1, 16), (0.25, 0.25), (0, 0)),
        (CAMERA.cropped(10, 4, 50, 40).reduced(1, 16), (0.25, 0.25), (10, 4)),
    ],
)
def test_pixels_of_other_images(camera, scale, shift):
    pixels, depths = CAMERA.project(POINTS)
    found, same = camera.project(POINTS)
    assert np.allclose(found, (pixels - shift) * scale) and np.allclose(same, depths)
    assert np.allclose(camera.shifted((5e5, 5e6, 100)).project(POINTS - (5e5, 5e6, 100))[0], found)


@pytest.mark.parametrize("camera", [CAMERA, CAMERA.cropped(10, 4, 50, 40)])
def test_quarter_turns(camera):
    """What is x to the right and y down goes to the right border and down, then comes back."""
    (x, y), depths = camera.project(POINTS)[0].T, camera.project(POINTS)[1]
    turned = camera.turned(1)
    pixels, same = turned.project(POINTS)
    assert (turned.width, turned.height) == (camera.height, camera.width)
    assert np.allclose(pixels.T, (camera.height - y, x)) and np.allclose(same, depths)
    again = turned.turned(3)
    assert np.allclose(again.project(POINTS)[0].T, (x, y)) and again.borders == camera.borders
    assert camera.turned(0) is camera and np.allclose(again.rotation, camera.rotation)


@pytest.mark.parametrize("width, height, most", [(5472, 3648, 1000), (1013, 700, 800)])
def test_the_longest_side_is_the_one_that_was_asked_for(width, height, most):
    camera = Camera.looking_at((0, 0, 0), (1, 2, 3), width=width, height=height)
    assert camera.reduced(1, most).width == most
