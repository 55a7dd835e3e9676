"""Interpolation: what the kernel reproduces, borders, missing places, and independence of patches."""

import numpy as np
import pytest

from clsplat.io.photos import resample as module
from clsplat.io.photos.resample import patches


def interpolated(image, places, round_trip=False):
    """[H, W] of an image [h, w]; 0 without a place."""
    result = np.zeros(places.shape[1:])
    for part, shown, source, weights in patches(places.astype(np.float32), image.shape[::-1], round_trip):
        result[part][shown] = weights @ image[source].ravel()
    return result


def grid(width, height):
    return np.array(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5))


@pytest.fixture
def image():
    return np.random.default_rng(0).uniform(0, 255, (9, 13))


def test_quadratic_images_are_reproduced():
    x, y = grid(13, 9)
    places = np.random.default_rng(1).uniform(2.5, 6.5, (2, 20, 30))
    found = interpolated(3 + x - 2 * y + x**2 - x * y + 0.5 * y**2, places)
    x, y = places
    assert np.allclose(found, 3 + x - 2 * y + x**2 - x * y + 0.5 * y**2, atol=1e-3)


def test_a_round_trip_has_no_border(image):
    moved = interpolated(image, grid(13, 9) + np.array([5, 0])[:, None, None], True)
    assert np.allclose(moved, np.roll(image, -5, axis=1))


def test_patches_and_missing_places_change_nothing(image, monkeypatch):
    places = np.random.default_rng(2).uniform(-1, 12, (2, 20, 30))
    whole = interpolated(image, places)
    places[:, 3] = np.nan
    places[:, 5:7, 4:9] = np.nan
    monkeypatch.setattr(module, "PATCH_SIDE", 7)
    found, known = interpolated(image, places), np.isfinite(places[0])
    assert np.array_equal(found[known], whole[known]) and not found[~known].any()
    assert not interpolated(image, np.full((2, 4, 5), np.nan)).any()
