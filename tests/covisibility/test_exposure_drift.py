"""Exposure drift: gains of photos are measured, other differences between them are not."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.covisibility.photometry import DRIFTS, exposure_drift
from clsplat.scene import View
from clsplat.training.photos import decoded

WIDTH, HEIGHT, DEPTH = 64, 48, 5.0


def a_view(name=""):
    return View(name, Camera(WIDTH, HEIGHT, (60.0, 60.0), (WIDTH / 2, HEIGHT / 2), np.eye(3), np.zeros(3)), b"")


def at_pixels(column, line, depth):
    """World points that the view sees in the middle of pixels."""
    return np.column_stack(
        [(column + 0.5 - WIDTH / 2) / 60 * depth, (line + 0.5 - HEIGHT / 2) / 60 * depth, np.full(len(column), depth)]
    )


def a_wall(count, seed=0):
    """Points, colours and photo of a wall, with one pixel for each point."""
    rng = np.random.default_rng(seed)
    line, column = np.divmod(rng.permutation(WIDTH * HEIGHT)[:count], WIDTH)
    colours = rng.integers(40, 160, (count, 3)).astype(np.uint8)
    photo = np.zeros((3, HEIGHT, WIDTH), np.uint8)
    photo[:, line, column] = colours.T
    return at_pixels(column, line, DEPTH), colours, photo


def brightened(photo, gain):
    return np.round(photo * gain).clip(0, 255).astype(np.uint8)


def some_gains(count=30, spread=0.1):
    return np.exp(np.random.default_rng(1).normal(0, spread, count))


def measured(gains, points, colours, photo):
    return exposure_drift([a_view()] * len(gains), (brightened(photo, g) for g in gains), points, colours)


def test_gains_are_measured():
    gains = some_gains()
    assert measured(gains, *a_wall(500)) == pytest.approx(np.log(gains).std(), rel=0.03)


def test_hidden_points_do_not_count(monkeypatch):
    """Every second photo sees dark points through the wall; more of them than the wall's own."""
    points, colours, photo = a_wall(WIDTH * HEIGHT)
    line, column = np.mgrid[:HEIGHT, :WIDTH].reshape(2, -1)
    hidden = np.tile(at_pixels(column, line, 2 * DEPTH), (3, 1))
    both = np.concatenate([points, hidden])
    of_both = np.concatenate([colours, np.full((len(hidden), 3), 20, np.uint8)])
    aside = a_view()  # stands between the wall and the hidden points
    aside = replace(aside, camera=replace(aside.camera, translation=np.array([0, 0, 0.5 - DEPTH])))
    views, photos = [a_view(), aside] * 4, [photo, brightened(photo, 0) + np.uint8(20)] * 4
    assert exposure_drift(views, photos, both, of_both) == 0
    monkeypatch.setattr("clsplat.covisibility.photometry.OCCLUSION_DEPTH", np.inf)
    assert exposure_drift(views, photos, both, of_both) > DRIFTS


def test_points_outside_behind_or_not_finite_do_not_count():
    points, colours, photo = a_wall(500)
    strange = np.concatenate(
        [
            points * [-1, -1, -1],
            np.full((500, 3), np.nan),
            points * [1, 1, 0],
            *(
                points + np.array(beside) * [WIDTH, HEIGHT, 0] / 60 * DEPTH  # next to the image
                for beside in ((-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0))
            ),
        ]
    )
    gains = some_gains()
    assert measured(gains, np.concatenate([points, strange]), np.resize(colours, (4000, 3)), photo) == measured(
        gains, points, colours, photo
    )


def test_the_scatter_of_few_points_is_not_drift():
    """A median of 30 points that scatter by 0.3 is uncertain by 0.07."""
    rng, (points, colours, photo) = np.random.default_rng(3), a_wall(30)
    photos = [brightened(photo, np.exp(rng.normal(0, 0.3, photo.shape[1:]))) for _ in range(300)]
    assert exposure_drift([a_view()] * 300, photos, points, colours) < DRIFTS


def test_the_sample_city_has_no_drift_until_its_photos_are_changed(city):
    views = [replace(view, camera=view.camera.reduced(4)) for view in city.views]
    photos = list(decoded(views))
    assert exposure_drift(views, photos, city.points, city.colours) < DRIFTS / 4
    gains = some_gains(len(views))
    changed = map(brightened, photos, gains)
    assert exposure_drift(views, changed, city.points, city.colours) == pytest.approx(np.log(gains).std(), rel=0.1)
