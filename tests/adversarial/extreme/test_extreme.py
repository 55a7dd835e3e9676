"""Every case of the extreme set is drawn or culled as it should be, and within its bound."""

import functools

import numpy as np
import pytest

from clsplat.constants import NO_ROW
from clsplat.loss.image_loss import image_loss
from tests.adversarial.extreme.cases import CASES, DOUBLE
from tests.kernels.chain import depth_order, gradients_by_row, precision_of, render, size_of
from tests.reference.blend import blend, blend_adjoint, fragile_pixels
from tests.reference.image_loss import image_loss as reference_loss
from tests.reference.project import project, project_adjoint

SSIM_WEIGHT = 0.2
# root of the smallest normal float32: Adam's square of a smaller gradient vanishes
NOTHING = 1e-19


@functools.cache
def by_reference(case):
    """The scene, its image, pixels whose value a comparison decides by less than the bound, the
    cotangent (zero there), and the gradients by row."""
    scene = case.scene()
    size, arguments = size_of(scene), (scene["camera"], scene["degree"], scene["near"])
    splats = project(scene["rows"], *arguments, antialiased=case.antialiased)
    order = depth_order(splats)
    fragile = fragile_pixels(splats, order, *size, tolerance=case.image)
    image, _, _ = blend(splats, order, *size, scene["background"])
    if "photo" in scene:
        _, cotangent, _, _ = reference_loss(image, scene["photo"] / 255, SSIM_WEIGHT)
        # |x - y| has a kink
        fragile |= (np.abs(image - scene["photo"] / 255) < 1e-6).any(0) & (image != 0).any(0)
    else:
        cotangent = np.random.default_rng(1).normal(size=image.shape)
    cotangent = np.where(fragile, 0, cotangent)
    by_splat = blend_adjoint(splats, order, *size, scene["background"], cotangent)
    with np.errstate(all="ignore"):
        gradients = project_adjoint(scene["rows"], *arguments, antialiased=case.antialiased, grads=by_splat)
    return scene, image, fragile, cotangent, gradients


@pytest.mark.parametrize(
    "case", [pytest.param(case, id=case.name, marks=[pytest.mark.slow] * case.slow) for case in CASES]
)
@pytest.mark.one_in(10)
def test_case(device, case):
    scene, expected, fragile, cotangent, expected_gradients = by_reference(case)
    assert fragile.mean() < 0.5, "thresholds decide too many pixels"
    renderer, rows, frame = render(device, scene, antialiased=case.antialiased)
    visible = frame.visible.download()
    np.testing.assert_array_equal(np.sort(visible), np.flatnonzero(scene["drawn"]))
    if "photo" in scene:
        _, grad = image_loss(device, frame.image, device.upload(scene["photo"]), SSIM_WEIGHT)
        cotangent = np.where(fragile, 0, grad.download())
    gradients = renderer.adjoint(rows, frame, device.upload(cotangent))
    skipped = visible[gradients.rows.download() == NO_ROW]
    np.testing.assert_array_equal(np.sort(skipped), np.flatnonzero(scene["skipped"]))
    assert renderer.skipped.download()[0] == len(skipped)

    single = precision_of(device) == "float"
    error = np.where(fragile, 0, frame.image.download() - expected)
    assert np.abs(error).max() <= (case.image if single else DOUBLE)
    gradients.rows = frame.visible
    actual = gradients_by_row(gradients, scene)
    healthy = scene["drawn"] & ~scene["skipped"]
    for name, gradient in expected_gradients.items():
        right, error = gradient[healthy], actual[name][healthy] - gradient[healthy]
        if name == "quaternions":  # a gradient is as the inverse of their length
            length = np.linalg.norm(scene["rows"][name][healthy], axis=1, keepdims=True)
            right, error = length * right, length * error
        size = max(np.linalg.norm(right), NOTHING * np.sqrt(right.size))
        assert np.linalg.norm(error) <= (case.gradient if single else DOUBLE) * size, name
