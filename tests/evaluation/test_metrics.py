"""Scores recover what was put in; the colour fit undoes a quadratic change of colours, no more.

LPIPS is that of a tiny network: the mean square of the difference of its inputs, -1 to 1.
"""

import sys
from pathlib import Path

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.evaluation import metrics
from clsplat.evaluation.metrics import Lpips, fit_colour, flip, psnr, ssim
from clsplat.evaluation.views import FINAL_METRICS, final_metrics
from tests.refusals import refused

DATA = Path(__file__).resolve().parents[1] / "data"
NETWORK, OF_ONE_SIZE = DATA / "mean_square.onnx", DATA / "mean_square_8.onnx"


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
    axis = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
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
    """Whatever is elsewhere; of SSIM whole windows, which a mask of a rectangle cuts like a border."""
    noisy = photo + np.random.default_rng(2).normal(0, 0.05, photo.shape)
    part, valid = (slice(20, 60), slice(10, 50)), np.zeros(photo.shape[:2], bool)
    valid[part] = True
    for other in (7, np.nan):
        spoilt = np.where(valid[..., None], noisy, other)
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


@pytest.fixture
def onnxruntime():
    return pytest.importorskip("onnxruntime", reason="the extra [lpips] is not installed")


@pytest.mark.usefixtures("onnxruntime")
def test_images_are_given_as_lpips_wants_them():
    rng = np.random.default_rng(0)
    image, photo = rng.random((2, 12, 17, 3)).astype(np.float32)
    found = Lpips(NETWORK)(image, photo)
    assert found == pytest.approx(4 * np.mean((image - photo) ** 2), rel=1e-5)
    assert Lpips(NETWORK)(image, image) == 0
    metrics = final_metrics(NETWORK)
    assert list(metrics) == [*FINAL_METRICS, "lpips"] and metrics["lpips"](image, photo) == found
    assert final_metrics() == FINAL_METRICS


@pytest.mark.usefixtures("onnxruntime")
def test_what_is_not_such_a_network(tmp_path):
    with pytest.raises(InputError, match="cannot compare images of 17x12 pixels.*dynamic axes"):
        Lpips(OF_ONE_SIZE)(np.zeros((12, 17, 3)), np.zeros((12, 17, 3)))
    refused(lambda: Lpips(tmp_path / "missing.onnx"), "no such file")
    for content in (b"", b"not a network", NETWORK.read_bytes()[:60]):
        (tmp_path / "damaged.onnx").write_bytes(content)
        with pytest.raises(InputError, match="damaged.onnx: not a network") as error:
            Lpips(tmp_path / "damaged.onnx")
        assert "\n" not in str(error.value)


def test_without_onnxruntime_the_cure_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    refused(lambda: Lpips(NETWORK), "pip install onnxruntime")


def quadratic(image):
    """A map like a change of exposure and white balance, that mixes all ten features."""
    r, g, b = np.moveaxis(image, -1, 0)
    return np.stack(
        [
            0.05 + 0.8 * r + 0.05 * g - 0.15 * r * r + 0.04 * r * g,
            0.02 + 0.9 * g + 0.03 * b - 0.1 * g * g + 0.05 * g * b,
            0.10 + 0.6 * b + 0.05 * r + 0.1 * b * b - 0.06 * b * r,
        ],
        axis=-1,
    )


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


@pytest.mark.parametrize("chunk", [1000, 1 << 14])  # the sums of many, and of one
def test_it_is_the_least_squares_fit(image, monkeypatch, chunk):
    monkeypatch.setattr(metrics, "CHUNK_PIXELS", chunk)
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
