"""One case on one device against the float64 reference: the errors of image and gradients."""

import functools
from dataclasses import dataclass

import numpy as np

from clsplat.constants import NO_ROW
from clsplat.loss.image_loss import image_loss
from tests.adversarial.extreme.cases import DOUBLE
from tests.kernels.chain import (
    depth_order,
    gradients_by_row,
    precision_of,
    render,
    size_of,
)
from tests.reference.blend import blend, blend_adjoint, fragile_pixels
from tests.reference.image_loss import image_loss as reference_loss
from tests.reference.project import project, project_adjoint

SSIM_WEIGHT = 0.2
# root of the smallest normal float32: Adam's square of a smaller gradient vanishes
NOTHING = 1e-19


@dataclass(frozen=True)
class Error:
    """value: the figure compared with the bound; worst: the element that is off most."""

    value: float
    worst: str


@dataclass(frozen=True)
class Measured:
    """image and gradients (field name -> Error) against the reference; drawn and skipped: bool[N],
    rows that were visible and that were marked; counted: how many the device says it skipped;
    compared: share of the pixels that no threshold makes undecided."""

    image: Error
    gradients: dict[str, Error]
    drawn: np.ndarray
    skipped: np.ndarray
    counted: int
    compared: float


def measure(device, case):
    scene, expected, fragile, cotangent, expected_gradients = _reference(case)
    renderer, rows, frame = render(device, scene, antialiased=case.antialiased)
    image = np.where(fragile, expected, frame.image.download())
    if "photo" in scene:
        _, grad = image_loss(device, frame.image, device.upload(scene["photo"]), SSIM_WEIGHT)
        cotangent = np.where(fragile, 0, grad.download())
    gradients = renderer.adjoint(rows, frame, device.upload(cotangent))
    marked = gradients.rows.download() == NO_ROW
    visible = frame.visible.download()
    count = len(scene["drawn"])
    skipped = np.isin(np.arange(count), visible[marked])
    gradients.rows = frame.visible
    actual = gradients_by_row(gradients, scene)
    healthy = scene["drawn"] & ~scene["skipped"]
    errors = {name: relative_l2(*(_of(name, g[name], scene, healthy)
                                  for g in (actual, expected_gradients)))
              for name in expected_gradients}
    return Measured(largest(image, expected), errors, np.isin(np.arange(count), visible), skipped,
                    renderer.skipped.download()[0], 1 - fragile.mean())


def _of(name, gradient, scene, healthy):
    """A gradient where rows are healthy, zero elsewhere; by quaternions times their length, since
    it is as the inverse of that."""
    result = np.zeros(gradient.shape)
    result[healthy] = gradient[healthy]
    if name == "quaternions":
        result[healthy] *= np.linalg.norm(scene["rows"][name][healthy], axis=1, keepdims=True)
    return result


def bound_of(device, bound):
    return bound if precision_of(device) == "float" else DOUBLE


def largest(actual, expected):
    """The largest absolute error."""
    return _error(actual, expected, lambda error: error.max(initial=0))


def relative_l2(actual, expected):
    size = max(np.linalg.norm(expected), NOTHING * np.sqrt(expected.size))
    return _error(actual, expected, lambda error: np.linalg.norm(error) / size)


def _error(actual, expected, norm):
    error = np.abs(actual - expected)
    if not error.size:
        return Error(0.0, "none")
    worst = np.unravel_index(np.argmax(np.where(np.isnan(error), np.inf, error)), error.shape)
    place = ", ".join(str(int(i)) for i in worst)
    return Error(float(norm(error)),
                 f"[{place}] is {actual[worst]:.9g}, not {expected[worst]:.9g}")


@functools.cache
def _reference(case):
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
        gradients = project_adjoint(
            scene["rows"], *arguments, antialiased=case.antialiased, grads=by_splat)
    return scene, image, fragile, cotangent, gradients
