"""The reference loss and the small references: against differences, skimage and plain numpy."""

import numpy as np
import pytest
from skimage.metrics import structural_similarity

from tests import cases
from tests.checks import adjoint_agrees, close
from tests.reference.adam import adam
from tests.reference.compact import compact
from tests.reference.gather import gather
from tests.reference.image_loss import image_loss, mean_ssim, window
from tests.reference.sort import sort_order
from tests.reference.statistics import accumulate


@pytest.mark.parametrize("size", cases.IMAGE_SIZES)
@pytest.mark.parametrize("weight, masked", [(0.0, False), (0.2, False), (1.0, False), (0.4, True)])
def test_gradient_agrees_with_differences(size, weight, masked):
    x, y = cases.images(*size)
    valid = cases.mask(*size) if masked else None
    adjoint_agrees(
        lambda point: {"loss": np.array(image_loss(point["x"], y, weight, valid)[0])},
        lambda point, grads: {"x": image_loss(point["x"], y, weight, valid)[1] * grads["loss"]},
        {"x": x},
        what=f"image loss {size}",
    )


def test_masked_pixels_are_like_those_beyond_the_border():
    """A frame of masked pixels around images changes nothing but the number of values."""
    x, y = cases.images(30, 20)
    inner = (slice(None), slice(4, 15), slice(6, 27))
    valid = np.zeros((20, 30), bool)
    valid[inner[1:]] = True
    loss, grad, *_ = image_loss(x[inner], y[inner], 0.2)
    framed_loss, framed_grad, *_ = image_loss(x, y, 0.2, valid)
    share = x[inner].size / x.size
    assert framed_loss == pytest.approx(loss * share)
    np.testing.assert_allclose(framed_grad[inner], grad * share, atol=1e-15)
    assert not framed_grad[:, ~valid].any()


def test_ssim_is_skimages_away_from_the_border():
    """Where the border's treatment cannot reach: equal images outside make SSIM 1 there, so the
    sums over the differing middle can be compared."""
    x, y = cases.images(60, 50)
    y[:, :15], y[:, -15:], y[:, :, :15], y[:, :, -15:] = x[:, :15], x[:, -15:], x[:, :, :15], x[:, :, -15:]
    theirs = structural_similarity(
        x, y, channel_axis=0, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1.0, full=True
    )[1]
    assert theirs.mean() < 0.97
    np.testing.assert_allclose(mean_ssim(x, y)[0], theirs.mean(), rtol=1e-7)


def test_window_sums_to_one_inside_and_loses_what_is_outside():
    under = window(np.ones((1, 21, 30)))[0]
    np.testing.assert_allclose(under[5:-5, 5:-5], 1)
    assert under[0, 0] == pytest.approx((0.5 + under[10, 0] - 0.5) ** 2) and under[10, 0] < 0.64
    impulse = np.zeros((1, 11, 11))
    impulse[0, 5, 5] = 1
    response = window(impulse)[0]
    np.testing.assert_allclose(response, response.T)
    assert response[5, 6] / response[5, 5] == pytest.approx(np.exp(-1 / 4.5))
    assert (response > 0).all()


def test_loss_of_equal_images_is_zero_and_parts_add_up():
    x, y = cases.images(30, 20)
    loss, grad, l1, ssim = image_loss(x, x, 0.2)
    assert loss == pytest.approx(0, abs=1e-14) and l1 == 0 and ssim == pytest.approx(1)
    np.testing.assert_allclose(grad, 0, atol=1e-14)
    loss, _, l1, ssim = image_loss(x, y, 0.2)
    assert l1 == pytest.approx(np.abs(x - y).mean())
    assert loss == pytest.approx(0.8 * l1 + 0.2 * (1 - ssim))


def test_first_adam_step_is_the_rate_and_other_rows_stay():
    rng = np.random.default_rng(0)
    value, grad = rng.normal(size=(2, 6, 3))
    zero = np.zeros((6, 3))
    moved, first, second = adam(value, grad, zero, zero, 1, 0.01, rows=np.array([1, 4]))
    np.testing.assert_allclose((value - moved)[[1, 4]], 0.01 * np.sign(grad[[1, 4]]))
    for changed, before in ((moved, value), (first, zero), (second, zero)):
        np.testing.assert_array_equal(changed[[0, 2, 3, 5]], before[[0, 2, 3, 5]])


def test_adam_by_hand_over_two_steps():
    value, first, second = np.ones(1), np.zeros(1), np.zeros(1)
    for step, grad in ((1, 2.0), (2, -1.0)):
        value, first, second = adam(value, np.array([grad]), first, second, step, 0.1)
    mean = (0.9 * 0.1 * 2 - 0.1 * 1) / (1 - 0.9**2)
    square = (0.999 * 0.001 * 4 + 0.001 * 1) / (1 - 0.999**2)
    np.testing.assert_allclose(value, 1 - 0.1 - 0.1 * mean / np.sqrt(square))
    still, _, _ = adam(np.ones(1), np.zeros(1), np.zeros(1), np.zeros(1), 1, 0.1)
    assert still == 1


def test_statistics_count_visible_rows_in_ndc_units():
    sums, counts = accumulate(
        np.array([1.0, 1, 1]),
        np.array([0, 5, 2]),
        np.array([[3.0, 0], [0, 2], [7, 7]]),
        np.array([True, True, False]),
        10,
        6,
    )
    np.testing.assert_allclose(sums, [16, 7, 1])
    np.testing.assert_array_equal(counts, [1, 6, 2])


def test_compact_sort_and_gather():
    kept, failed = compact(np.array([0, 1, 1, 0, 1]), 3)
    assert kept.tolist() == [1, 2, 4] and not failed
    kept, failed = compact(np.array([0, 1, 1, 0, 1]), 2)
    assert kept.tolist() == [] and failed
    assert not compact(np.zeros(0), 0)[1]
    assert sort_order(np.array([2, 1, 2, 0, 1])).tolist() == [3, 1, 4, 0, 2]
    rows = np.arange(6).reshape(3, 2)
    np.testing.assert_array_equal(gather(rows, [2, 0, 2]), [[4, 5], [0, 1], [4, 5]])
    assert gather(rows, []).shape == (0, 2)


def test_close_names_the_worst_element():
    expected = np.array([[1.0, 2], [3, 0]])
    close(expected * (1 + 5e-5) + 1e-5, expected, "float", "near")
    for actual, precision, text in (
        (expected + [[0, 0], [0.1, 0]], "float", r"\[1, 0\]"),
        (expected * (1 + 1e-9), "double", "4 of 4|3 of 4"),
        (np.where(expected == 3, np.nan, expected), "float", r"not finite.*\[1, 0\]"),
        (expected[0], "float", "shape"),
    ):
        with pytest.raises(AssertionError, match=text):
            close(actual, expected, precision, "far")
    close([np.nan, np.inf, 1], [np.nan, np.inf, 1], "double", "same")
    with pytest.raises(AssertionError, match="wrongly finite"):
        close([1.0], [np.nan], "float", "hidden poison")


def test_adjoint_agrees_refuses_a_wrong_adjoint():
    point = {"x": np.array([0.3, 0.7]), "y": np.array([1.0, 2.0])}

    def function(p):
        return {"z": p["x"] * p["y"]}

    def adjoint(p, grads):
        return {"x": grads["z"] * p["y"], "y": grads["z"] * p["x"]}

    adjoint_agrees(function, adjoint, point)
    with pytest.raises(AssertionError, match="along y"):
        adjoint_agrees(function, lambda p, g: {**adjoint(p, g), "y": g["z"] * p["x"] * 1.00001}, point)
