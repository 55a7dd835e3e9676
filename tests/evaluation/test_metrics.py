"""PSNR, SSIM and FLIP recover what was put in."""

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.evaluation.metrics import flip, psnr, ssim


@pytest.fixture
def photo():
    return np.random.default_rng(0).uniform(0.2, 0.8, (96, 80, 3)).astype(np.float32)


@pytest.mark.parametrize("sigma", [0.003, 0.03])
def test_known_noise_gives_known_psnr(photo, sigma):
    noise = np.random.default_rng(1).normal(0, sigma, photo.shape)
    assert psnr(photo + noise, photo) == pytest.approx(-20 * np.log10(sigma), abs=0.1)


def test_a_constant_error_is_exact():
    photo = np.full((16, 20, 3), 0.25)
    assert psnr(photo + 0.1, photo) == pytest.approx(20.0, abs=1e-9)


@pytest.mark.filterwarnings("error")
def test_equal_and_black_images_do_not_fail(photo):
    black = np.zeros_like(photo)
    for image in (photo, black):
        assert psnr(image, image) == np.inf
        assert ssim(image, image) == pytest.approx(1.0, abs=1e-12)
    assert np.isfinite(psnr(black, photo)) and np.isfinite(ssim(black, photo))


def test_ssim_is_that_of_wang_et_al(photo):
    """The map written out for one channel with an explicit 11x11 window."""
    image = np.clip(photo + np.random.default_rng(2).normal(0, 0.05, photo.shape), 0, 1)
    axis = np.exp(-np.arange(-5, 6) ** 2 / (2 * 1.5**2))
    window = np.outer(axis, axis) / axis.sum() ** 2

    def mean(values):
        return (np.lib.stride_tricks.sliding_window_view(values, (11, 11)) * window).sum((2, 3))

    expected = []
    for channel in range(3):
        x, y = image[..., channel].astype(float), photo[..., channel].astype(float)
        mx, my = mean(x), mean(y)
        vx, vy, cov = mean(x * x) - mx * mx, mean(y * y) - my * my, mean(x * y) - mx * my
        top = (2 * mx * my + 0.01**2) * (2 * cov + 0.03**2)
        expected.append((top / ((mx**2 + my**2 + 0.01**2) * (vx + vy + 0.03**2))).mean())
    assert ssim(image, photo) == pytest.approx(np.mean(expected), abs=1e-9)


def test_an_image_smaller_than_the_window_is_refused():
    with pytest.raises(InputError, match="40x10 pixels.*11x11.*--downscale.*--max-resol"):
        ssim(np.zeros((10, 40, 3)), np.zeros((10, 40, 3)))


def test_only_pixels_that_count_count(photo):
    """Whatever is elsewhere; of SSIM whole windows, which a mask of a rectangle cuts like a border.
    """
    noisy = photo + np.random.default_rng(2).normal(0, 0.05, photo.shape)
    part, valid = (slice(20, 60), slice(10, 50)), np.zeros(photo.shape[:2], bool)
    valid[part] = True
    spoilt = np.where(valid[..., None], noisy, 7)
    assert psnr(spoilt, photo, valid) == pytest.approx(psnr(noisy[part], photo[part]))
    assert ssim(spoilt, photo, valid) == pytest.approx(ssim(noisy[part], photo[part]))
    every = np.ones_like(valid)
    assert ssim(noisy, photo, every) == pytest.approx(ssim(noisy, photo))
    valid[:] = False
    valid[30:33, 30:60] = True  # too thin for a window
    assert 0 < ssim(noisy, photo, valid) < 1


def test_flip_is_that_of_srgb_images(photo):
    """The paper's formulas, in float64 numpy, gave these means."""
    black = np.zeros((32, 32, 3))
    assert flip(black, black) == 0
    assert flip(black, black + 1) == pytest.approx(0.967, abs=2e-3)
    assert flip(photo[::-1], photo) == pytest.approx(0.3110, abs=2e-4)
    valid = np.zeros(photo.shape[:2], bool)
    valid[20:60] = True
    assert flip(np.where(valid[..., None], photo, 0), photo, valid) == 0
