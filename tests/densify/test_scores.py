"""Scores of Taming 3DGS: every term from the reference, and which gaussians and pixels count."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import sobel

from clsplat.densify import scores
from clsplat.densify.scores import blending_weights, pixel_weights, taming_scores
from tests import cases
from tests.checks import close
from tests.kernels.chain import depth_order, render, size_of
from tests.reference.contribution import contribution
from tests.reference.image_loss import image_loss
from tests.reference.project import project

SSIM_WEIGHT = 0.2
NAME = "degree_1"


def photo_of(width, height, seed):
    return np.round(cases.images(width, height, seed)[0] * 255).astype(np.uint8)


def scored(device, name, gradient, photos, rows=None):
    """Scores over one camera's view with each photo, and the downloaded (visible, image)."""
    case = cases.gaussians(name)
    renderer, rows, frame = render(device, case, rows)
    views = [SimpleNamespace(camera=frame.camera, photo=device.upload(photo)) for photo in photos]
    scores = taming_scores(renderer, rows, views, case["degree"], SSIM_WEIGHT, gradient)
    return scores, frame.visible.download(), frame.image.download()


def expected_scores(name, gradient, photo, image):
    """The published sum, by the reference; only the image is the device's."""
    case = cases.gaussians(name)
    rows, (width, height) = case["rows"], size_of(case)
    splats = project(rows, case["camera"], case["degree"], case["near"])
    order = depth_order(splats)
    difference = np.abs(image - photo / 255).mean(0)
    grey = 0.299 * photo[0] + 0.587 * photo[1] + 0.114 * photo[2]
    edges = np.sqrt(sobel(grey, 0) ** 2 + sobel(grey, 1) ** 2)
    weights = sum(50 * (m - m.min()) / (m.max() - m.min()) for m in (difference, edges))
    assert weights.shape == (height, width)
    pixels, weight, weighted, distance = contribution(splats, order, weights).T
    a, b, c = splats["conics"].T
    conics = np.moveaxis(np.array([[a, b], [b, c]]), 2, 0)
    smallest = np.array([np.linalg.eigvalsh(k).min() if k.any() else np.inf for k in conics])
    terms = (
        (25, gradient),
        (100, 1 / (1 + np.exp(-rows["opacity_logits"]))),
        (5, splats["depths"]),
        (10, 3 / np.sqrt(smallest)),
        (25, np.exp(rows["log_scales"]).prod(1)),
        (50, distance),
        (10, weighted),
        (0.1, pixels),
        (50, weight),
    )
    loss, *_ = image_loss(image, photo / 255, SSIM_WEIGHT)
    seen, total = splats["visible"], np.zeros(len(gradient))
    for coefficient, values in terms:
        total += coefficient * values / np.median(values[seen & (values > 0)])
    return np.where(seen, 50 * loss * total, 0)


def gradient_of(count):
    gradient = np.abs(np.random.default_rng(1).normal(size=count)) * 1e-4
    gradient[::3] = 0  # its median is that of the others
    return gradient


@pytest.mark.slow
@pytest.mark.parametrize("name", [NAME, "needles", "opacities"])
def test_the_published_sum(double_device, name):
    case = cases.gaussians(name)
    gradient = gradient_of(len(case["rows"]["positions"]))
    photo = photo_of(*size_of(case), 0)
    scores, visible, image = scored(double_device, name, gradient, [photo])
    assert len(visible) < len(scores) or name != "opacities"  # the others are all seen
    expected = expected_scores(name, gradient, photo, image)
    close(scores, expected, "double", name)
    assert (scores[visible] > 0).all() and scores.dtype == np.float64


@pytest.mark.slow
def test_single_precision_is_close(float_device):
    case = cases.gaussians(NAME)
    gradient, photo = gradient_of(25), photo_of(*size_of(case), 0)
    scores, _, image = scored(float_device, NAME, gradient, [photo])
    expected = expected_scores(NAME, gradient, photo, image.astype(float))
    # a pixel more or less at the edge of a splat is allowed
    assert np.abs(scores - expected).max() < 0.01 * expected.max()


@pytest.mark.slow
def test_views_add_up(double_device):
    size, gradient = size_of(cases.gaussians(NAME)), gradient_of(25)
    photos = [photo_of(*size, seed) for seed in (0, 1)]
    each = [scored(double_device, NAME, gradient, [photo])[0] for photo in photos]
    both = scored(double_device, NAME, gradient, photos)[0]
    close(both, each[0] + each[1], "double", "two views")
    assert not scored(double_device, NAME, gradient, [])[0].any()


def test_nothing_to_score(device):
    """No gaussian at all; none with a gradient; a black photo has no edges."""
    black = np.zeros((3, 40, 48), np.uint8)
    assert scored(device, "empty", np.zeros(0), [black])[0].shape == (0,)
    black = np.zeros((3, 17, 33), np.uint8)
    scores, visible, _ = scored(device, NAME, np.zeros(25), [black])
    assert np.isfinite(scores).all() and (scores[visible] > 0).all()


def test_pixels_weigh_by_error_and_edges():
    photo = np.zeros((3, 8, 9), np.uint8)
    photo[:, :, 5:] = 255  # an edge between columns 4 and 5
    image = photo / 255
    image[:, 2, 1] = 0.4
    weights = pixel_weights(image, photo)
    assert weights[2, 1] == 50 and np.allclose(weights[:, 4:6], 50)
    weights[2, 1] = 0
    assert not weights[:, :4].any() and not weights[:, 6:].any()
    assert not pixel_weights(np.full((3, 8, 9), 0.5), np.zeros((3, 8, 9), np.uint8)).any()


@pytest.mark.slow
@pytest.mark.parametrize("name", [NAME, "opacities"])
def test_blending_weights_share_what_a_view_covers(double_device, monkeypatch, name):
    """Of all gaussians in two views together: twice the opacity of one, summed over its pixels."""
    case = cases.gaussians(name)
    renderer, rows, frame = render(double_device, case)
    camera = frame.camera, *size_of(case)
    weights = blending_weights(renderer, rows, [camera, camera])
    covered = 1 - frame.blended.transmittance.download()
    assert weights.sum() == pytest.approx(2 * covered.sum(), rel=1e-9)
    unseen = np.setdiff1d(np.arange(len(weights)), frame.visible.download())
    assert not weights[unseen].any() and np.count_nonzero(weights) > len(weights) / 4
    # of three views two are rendered, the first and the last, and stand for all
    monkeypatch.setattr(scores, "MOST_WEIGHED", 2)
    fewer = blending_weights(renderer, rows, [camera, None, camera])
    assert np.allclose(fewer, 1.5 * weights, rtol=1e-12)
