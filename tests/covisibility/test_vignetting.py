"""Vignetting is measured, and other differences between photos are not."""

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.covisibility.photometry import corner_darkening
from clsplat.response import Response, corner_radius
from clsplat.scene import View

SIZE = 96, 64
RNG = np.random.default_rng(0)
POINTS = np.column_stack([RNG.uniform(-3, 3, (3000, 2)), np.full(3000, 4.0)])
SHADES = RNG.uniform(60, 160, 3000)


def views(count=12):
    """Cameras that move along a wall; each shows the points elsewhere in its photo."""
    return [
        View(
            f"{i}",
            Camera(*SIZE, (80, 80), (48, 32), np.eye(3), np.array([0.25 * (i - count / 2), 0.1 * (i % 5 - 2), 0])),
            b"",
        )
        for i in range(count)
    ]


def photos(gains, factors):
    """Points as pixels of their shade times the gain of their photo, darker in the corners."""
    for view, gain in zip(views(len(gains)), gains):
        pixel, _ = view.camera.project(POINTS)
        inside = ((pixel >= 0) & (pixel < SIZE)).all(axis=1)
        column, row = pixel[inside].astype(int).T
        photo = np.zeros((3, *SIZE[::-1]), np.uint8)
        lens = np.append(factors, 1 / corner_radius(view.camera))
        light = gain * Response(vignetting=lens).gain(view.camera)
        photo[:, row, column] = np.round(light[row, column] * SHADES[inside])
        yield photo


@pytest.mark.parametrize("loss", [0.0, 0.1, 0.3])
def test_the_loss_in_the_corners_is_found_whatever_the_exposure(loss):
    gains = np.random.default_rng(1).uniform(0.7, 1.3, 12)
    found = corner_darkening(views(), photos(gains, [-loss, 0, 0]), POINTS)
    assert found == pytest.approx(loss, abs=0.03)


def test_brighter_corners_are_below_zero():
    assert corner_darkening(views(), photos(np.ones(12), [0.2, 0, 0]), POINTS) < -0.1


def test_what_no_two_photos_show_tells_nothing():
    assert corner_darkening([], [], POINTS) == 0
    (first,) = photos([1.0], [-0.3, 0, 0])
    assert corner_darkening(views(1), [first], POINTS) == 0
