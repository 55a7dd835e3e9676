"""The colour fit undoes a quadratic change of colours and nothing else."""

import numpy as np
import pytest

from clsplat.evaluation.metrics import fit_colour, psnr


def quadratic(image):
    """A map like a change of exposure and white balance, that mixes all ten features."""
    r, g, b = np.moveaxis(image, -1, 0)
    return np.stack([
        0.05 + 0.8 * r + 0.05 * g - 0.15 * r * r + 0.04 * r * g,
        0.02 + 0.9 * g + 0.03 * b - 0.1 * g * g + 0.05 * g * b,
        0.10 + 0.6 * b + 0.05 * r + 0.1 * b * b - 0.06 * b * r], axis=-1)


@pytest.fixture
def image():
    return np.random.default_rng(0).uniform(0, 1, (60, 50, 3))


def test_a_quadratic_change_is_undone(image):
    photo = quadratic(image)
    assert photo.min() > 0 and photo.max() < 1  # clipping must not take part
    assert np.abs(image - photo).max() > 10 / 255
    assert np.abs(fit_colour(image, photo) - photo).max() < 1e-9


def test_faint_colours_can_be_restored():
    """Channels that agree within a level make the features nearly coincide; they still differ."""
    rng = np.random.default_rng(1)
    image = rng.uniform(0.1, 0.9, (60, 50, 1)) + rng.normal(0, 1e-3, (60, 50, 3))
    photo = image + 40 * (image[..., :1] - image[..., 1:2])
    assert np.abs(photo - image).max() > 20 / 255
    inside = (photo > 0) & (photo < 1)
    assert np.abs(fit_colour(image, photo) - photo)[inside].max() < 0.1 / 255


def test_it_is_the_least_squares_fit(image):
    photo = np.clip(quadratic(image) + np.random.default_rng(2).normal(0, 0.01, image.shape), 0, 1)
    r, g, b = image.reshape(-1, 3).T
    design = np.stack([np.ones_like(r), r, g, b, r * r, r * g, r * b, g * g, g * b, b * b], 1)
    best = (design @ np.linalg.lstsq(design, photo.reshape(-1, 3))[0]).reshape(photo.shape)
    assert np.abs(fit_colour(image, photo) - best.clip(0, 1)).max() < 1e-9


@pytest.mark.parametrize("level", [0.0, 0.3, 1.0])
def test_constant_images_take_the_mean_colour(level, image):
    fitted = fit_colour(np.full_like(image, level), image)
    assert np.abs(fitted - image.mean((0, 1))).max() < 1e-6


def test_the_fit_never_makes_an_image_worse(image):
    photo = np.clip(image + np.random.default_rng(3).normal(0, 0.1, image.shape), 0, 1)
    assert psnr(fit_colour(image, photo), photo) >= psnr(image, photo)


def test_masked_pixels_do_not_decide_the_fit():
    rng = np.random.default_rng(3)
    photo = rng.random((20, 30, 3))
    image, valid = 0.5 * photo + 0.1, np.ones((20, 30), bool)
    valid[:, :10] = False
    image[~valid] = rng.random((200, 3))
    fitted = fit_colour(image, photo, valid)
    assert np.allclose(fitted[valid], photo[valid], atol=1e-6)
    assert not np.allclose(fit_colour(image, photo)[valid], photo[valid], atol=1e-2)
