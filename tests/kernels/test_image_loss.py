"""L1 and SSIM against a photo, and the gradient, on images around the sizes of tiles and strips."""

import numpy as np
import pytest

from clsplat.loss import image_loss as module
from clsplat.loss.image_loss import image_loss, loss_value
from tests import cases
from tests.checks import close
from tests.kernels.chain import precision_of
from tests.reference.image_loss import image_loss as reference

# one pixel, less than the window, tile (32 x 22) and strip borders and one beside them. The item
# form's strips have 64 columns and read 10 more on both sides: the last columns alone in a strip or
# vector, and a strip in the middle that reads to the border (150) and beyond it (149)
SIZES = (
    (1, 1),
    (7, 5),
    (15, 17),
    (16, 16),
    (17, 15),
    (32, 11),
    (61, 37),
    (48, 40),
    (64, 9),
    (65, 33),
    (33, 22),
    (31, 23),
    (32, 45),
    (74, 6),
    (81, 12),
    (149, 7),
    (150, 7),
)
WEIGHT = 0.2


@pytest.fixture(autouse=True)
def short_strips(monkeypatch):
    monkeypatch.setattr(module, "STRIP_ROWS", 16)


def a_pair(width, height, seed=0):
    """A render float64[3, H, W] and a photo uint8[3, H, W]."""
    render, photo = cases.images(width, height, seed)
    return render, np.round(photo * 255).astype(np.uint8)


def masked(photo, valid):
    """A photo with a mask, uint8[4, H, W]."""
    return np.concatenate([photo, valid[None] * np.uint8(255)])


def check(device, render, photo, what, weight=WEIGHT, valid=True):
    precision = precision_of(device)
    given = photo if valid is True else masked(photo, valid)
    sums, grad = image_loss(device, device.upload(render), device.upload(given), weight)
    expected, expected_grad, l1, ssim = reference(render, photo / 255, weight, valid)
    # |x - y| has a kink: where the two are as good as equal, its sign is a matter of rounding
    undecided = np.abs(render - photo / 255) < 1e-6
    close(np.array(loss_value(sums, render.size, weight)), [expected, l1, ssim], precision, what)
    close(
        np.where(undecided, 0, grad.download()), np.where(undecided, 0, expected_grad), precision, f"{what}: gradient"
    )


@pytest.mark.double
@pytest.mark.oclgrind
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_value_and_gradient(device, size):
    check(device, *a_pair(*size), f"{size}")


@pytest.mark.oclgrind
@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.one_in(5)
def test_value_and_gradient_with_a_mask(device, size):
    check(device, *a_pair(*size, 8), f"{size} with a mask", valid=cases.mask(*size))


def test_nothing_under_a_mask_matters(device):
    """Neither the photo nor the render, not even if it is not finite."""
    render, photo = a_pair(70, 45, 10)
    valid = cases.mask(70, 45)
    results = []
    for spoilt in (False, True):
        if spoilt:
            render[:, ~valid], photo[:, ~valid] = np.nan, 255 - photo[:, ~valid]
        results.append(
            [
                r.download()
                for r in image_loss(device, device.upload(render), device.upload(masked(photo, valid)), WEIGHT)
            ]
        )
    assert all(np.array_equal(*values) for values in zip(*results))


def test_gradients_do_not_depend_on_strips(device, monkeypatch):
    """Nor do rows that two strips both read lose or gain anything in the sums."""
    render, photo = (device.upload(values) for values in a_pair(70, 45, 7))
    results = []
    for rows in (1, 5, 16, 45):
        monkeypatch.setattr(module, "STRIP_ROWS", rows)
        results.append([r.download() for r in image_loss(device, render, photo, WEIGHT)])
    for sums, grad in results[1:]:
        assert np.array_equal(grad, results[0][1])
        assert np.allclose(sums.sum(axis=0), results[0][0].sum(axis=0), rtol=1e-6, atol=0)


@pytest.mark.parametrize("with_mask", [False, True])
def test_waves_do_not_matter(group_device, monkeypatch, with_mask):
    """Of 32 and 64 lanes, which have different numbers in local memory at once."""
    render, photo = a_pair(70, 45, 11)
    given = masked(photo, cases.mask(70, 45)) if with_mask else photo
    results = []
    for wave in (32, 64):
        monkeypatch.setattr(group_device, "wave", wave)
        check(group_device, render, photo, f"waves of {wave}", valid=cases.mask(70, 45) if with_mask else True)
        results.append(
            [
                r.download()
                for r in image_loss(group_device, group_device.upload(render), group_device.upload(given), WEIGHT)
            ]
        )
    assert all(np.array_equal(*values) for values in zip(*results))


FLAT = [(render, photo) for render in (0.0, 1.0, 1e-20, 0.7, 30.0) for photo in (0, 255)]


def flat_pair(render_value, photo_value):
    return (np.full((3, 19, 23), cases.single(render_value)), np.full((3, 19, 23), photo_value, np.uint8))


def test_flat_images_in_single_precision(float_device):
    """Of a flat patch's variance, E[x^2] - E[x]^2, rounding leaves up to a thousandth of C2."""
    for values in FLAT[:-2]:
        render, photo = flat_pair(*values)
        sums, grad = image_loss(float_device, float_device.upload(render), float_device.upload(photo), WEIGHT)
        expected, expected_grad, *_ = reference(render, photo / 255, WEIGHT)
        assert abs(loss_value(sums, render.size, WEIGHT)[0] - expected) < 1e-3, values
        assert np.abs(grad.download() - expected_grad).max() * render.size < 0.05, values


def test_a_pixel_that_is_not_finite_stays_in_its_window(device):
    """Its gradient reaches 2 x 5 pixels, of its own channel."""
    render, photo = a_pair(48, 40, 4)
    render[1, 20, 24] = np.nan
    _, grad = image_loss(device, device.upload(render), device.upload(photo), WEIGHT)
    bad = ~np.isfinite(grad.download())
    assert bad[1, 20, 24] and not bad[[0, 2]].any()
    lines, columns = np.nonzero(bad[1])
    assert np.abs(lines - 20).max() <= 10 and np.abs(columns - 24).max() <= 10
