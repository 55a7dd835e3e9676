"""A correctness self-test for any driver, in a few seconds: `check(device)`.

An error of a driver or compiler shows here and not as a bad model after hours: the kernels of which
every training consists run in both forms, in single precision, and are compared with numpy or with
themselves.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import correlate1d

from clsplat.camera import Camera
from clsplat.constants import (
    NO_ROW,
    SH_C0,
    SPLAT_CONIC,
    SPLAT_CUTOFF,
    SPLAT_DEPTH,
    SPLAT_EXTENT_Y,
    SPLAT_MEAN,
    SPLAT_REALS,
)
from clsplat.densify.statistics import Statistics
from clsplat.device import Device
from clsplat.gaussians import LEARNED
from clsplat.loss.image_loss import image_loss, loss_value
from clsplat.optimise.adam import DeviceAdam
from clsplat.optimise.numpy_adam import adam_update
from clsplat.primitives.compact import compact, new_counts
from clsplat.primitives.gather import gather, scatter
from clsplat.primitives.reduce import sum_columns
from clsplat.primitives.sort import stable_sort
from clsplat.rendering.bin import bin_splats, tile_grid
from clsplat.rendering.cull import cull
from clsplat.rendering.pipeline import Gradients, Renderer
from clsplat.rendering.project import LOW_PASS, pack_camera

SH_C1 = np.sqrt(3 / (4 * np.pi))
NEAR = 0.1
CAMERA = Camera(90, 70, (80.0, 75.0), (44.0, 36.0), np.eye(3), np.array([0.1, -0.2, 0.3]))
BACKGROUND = (0.1, 0.3, 0.2)


# name, whether it passed, and the measured error with its bound or what the driver raised
Result = tuple[str, bool, str]
Measured = tuple[float, float, str]  # error, its bound, its kind
Rows = dict[str, NDArray[np.float64]]


def check(device: Device) -> list[Result]:
    """The results of every check, in both kernel forms on the device of `device`."""
    forms = [Device(device.handle, form=form) for form in ("item", "group")]
    return [*check_form(forms[0]), *check_form(forms[1]),
            _result("render, both forms", forms_agree, *forms)]


def check_form(device: Device) -> list[Result]:
    """The same as `check`, in the form and precision in which the device is open."""
    return [_result(f"{name}, {device.form} form", test, device) for name, test in CHECKS]


def _result(name: str, test: Callable[..., Measured], *devices: Device) -> Result:
    try:
        error, bound, kind = test(*devices)
    except Exception as raised:  # a driver may raise anything, and that is the result
        return name, False, " ".join(f"{type(raised).__name__}: {raised}".split())[:300]
    return name, bool(error <= bound), f"{kind} {error:.2g}, bound {bound:g}"


def _relative(actual: ArrayLike, expected: ArrayLike) -> float:
    """Root mean square of the difference over that of the expected values."""
    actual, expected = np.asarray(actual, np.float64), np.asarray(expected, np.float64)
    return float(np.linalg.norm(actual - expected) / np.linalg.norm(expected))


def _wrong(*pairs: tuple[NDArray[Any], NDArray[Any]]) -> Measured:
    """The number of integers that differ between the arrays of each pair."""
    return sum(int((actual != expected).sum()) for actual, expected in pairs), 0, "wrong values"


# --- primitives


def sort(device: Device) -> Measured:
    """Keys of which many are equal."""
    rng = np.random.default_rng(1)
    keys = rng.choice(rng.integers(0, 2**32, 5000, dtype=np.uint32), 30_011)  # many equal
    sorted_keys, order = stable_sort(device, device.upload(keys), new_counts(device, len(keys)))
    expected = np.argsort(keys, kind="stable")
    return _wrong((sorted_keys.download(), keys[expected]), (order.download(), expected))


def rows_by_index(device: Device) -> Measured:
    """Gather in a random order, and scatter back."""
    rng = np.random.default_rng(2)
    rows, order = rng.random((5003, 3), np.float32), rng.permutation(5003).astype(np.uint32)
    gathered = gather(device, device.upload(rows), device.upload(order))
    back = device.zeros(rows.shape)
    scatter(device, gathered, device.upload(order), back)
    return _wrong((gathered.download(), rows[order]), (back.download(), rows))


def compaction(device: Device) -> Measured:
    """The rows of random flags."""
    flags = np.random.default_rng(3).integers(0, 2, 100_003, dtype=np.uint32)
    kept = compact(device, device.upload(flags), new_counts(device))
    expected = np.flatnonzero(flags)
    if len(kept) != len(expected):
        return abs(len(kept) - len(expected)), 0, "rows too many or too few"
    return _wrong((kept.download(), expected))


def sums(device: Device) -> Measured:
    """Column sums against float64."""
    rows = np.random.default_rng(4).random((50_021, 2), np.float32)
    totals = sum_columns(device, device.upload(rows)).download()
    return _relative(totals, rows.sum(0, dtype=np.float64)), 1e-6, "relative error"


# --- training


def adam(device: Device) -> Measured:
    """Two steps on varying rows; one row's gradient is marked as not finite."""
    rng = np.random.default_rng(5)
    expected = {f.name: rng.normal(size=(50, f.width(1))).astype(np.float32) for f in LEARNED}
    rows = {f.name: device.upload(expected[f.name].reshape(50, *f.row_shape(1))) for f in LEARNED}
    engine, rates = DeviceAdam(device, rows), {f.name: f.rate for f in LEARNED}
    moments = {name: np.zeros((2, *values.shape), np.float32) for name, values in expected.items()}
    for step in (1, 2):
        seen = rng.permutation(50)[:40].astype(np.uint32)
        fields = {}
        for f in LEARNED:
            gradient = rng.normal(size=(40, f.width(1))).astype(np.float32)
            fields[f.name] = device.upload(gradient.reshape(40, *f.row_shape(1)))
            first, second = moments[f.name][:, seen[1:]]
            expected[f.name][seen[1:]], *moments[f.name][:, seen[1:]] = adam_update(
                expected[f.name][seen[1:]], gradient[1:], first, second, step, f.rate)
        visible = device.upload(seen)
        seen[0] = NO_ROW
        gradients = Gradients(fields, device.zeros((40, 2)), device.upload(seen), visible,
                              new_counts(device, len(seen)))
        engine.step(rows, gradients, step, rates, {f.name: f.width(1) for f in LEARNED})
    error = max(_relative(rows[name].download().reshape(50, -1), values)
                for name, values in expected.items())
    return error, 1e-6, "relative error"


def _losses(image: NDArray[np.float64], photo: NDArray[np.float64], ssim_weight: float) -> float:
    """The loss in float64: 11 taps of a gaussian of sigma 1.5 (Wang et al. 2004)."""
    taps = np.exp(-np.arange(-5, 6)**2 / 4.5)

    def window(values: NDArray[np.float64]) -> NDArray[np.float64]:
        rows = correlate1d(values, taps / taps.sum(), axis=-1, mode="constant")
        means: NDArray[np.float64] = correlate1d(
            rows, taps / taps.sum(), axis=-2, mode="constant")
        return means

    mean, photo_mean = window(image), window(photo)
    variances = window(image**2 + photo**2) - mean**2 - photo_mean**2
    covariance = window(image * photo) - mean * photo_mean
    ssim = ((2 * mean * photo_mean + 0.01**2) * (2 * covariance + 0.03**2)
            / ((mean**2 + photo_mean**2 + 0.01**2) * (variances + 0.03**2)))
    return float((1 - ssim_weight) * np.abs(image - photo).mean()
                 + ssim_weight * (1 - ssim.mean()))


def _loss_case(device: Device) -> tuple[
        Callable[[NDArray[np.float64]], float], NDArray[np.float64], float, NDArray[Any]]:
    """The float64 loss as a function of the image, an image, and its loss and gradient by the
    device."""
    rng = np.random.default_rng(7)
    photo = rng.integers(0, 256, (3, 41, 53), np.uint8)
    # further from the photo than the difference quotient's step, as |x - y| has a kink
    image = photo / 255 + rng.choice((-1, 1), photo.shape) * rng.uniform(0.02, 0.2, photo.shape)
    totals, grad = image_loss(device, device.upload(image), device.upload(photo), 0.2)
    value, _, _ = loss_value(totals, photo.size, 0.2)
    return lambda x: _losses(x, photo / 255, 0.2), image, value, grad.download()


def loss(device: Device) -> Measured:
    """The loss against float64."""
    function, image, value, _ = _loss_case(device)
    return abs(value - function(image)), 1e-5, "error"


def loss_adjoint(device: Device) -> Measured:
    """The gradient of the loss against the difference quotient."""
    function, image, _, grad = _loss_case(device)
    return _slope_error(function, image, grad, step=1e-4), 1e-4, "relative error"


def _slope_error(function: Callable[[NDArray[np.float64]], float], point: NDArray[np.float64],
                 grad: ArrayLike, step: float) -> float:
    """|difference quotient - adjoint| along a random direction, relative to the sum's terms."""
    direction = np.random.default_rng(8).normal(size=point.shape)
    values = {k: function(point + k * step * direction) for k in (-2, -1, 1, 2)}
    quotient = (8 * (values[1] - values[-1]) - values[2] + values[-2]) / (12 * step)
    terms = np.asarray(grad, np.float64) * direction
    return float(abs(quotient - terms.sum()) / max(abs(quotient), np.linalg.norm(terms)))


# --- rendering


def _gaussians(count: int, scale: float) -> Rows:
    """Rows of degree 1 in front of CAMERA, at distinct depths, about `scale` world units large."""
    rng = np.random.default_rng(9)
    depth = rng.permutation(np.linspace(2, 6, count))
    positions = np.column_stack([rng.uniform(-0.5, 0.5, (count, 2)) * depth[:, None], depth])
    rows = {"positions": positions - CAMERA.translation,
            "sh_constant": rng.uniform(0, 1, (count, 3)) / SH_C0,
            "sh_rest": rng.normal(0, 0.1, (count, 3, 3)),
            "opacity_logits": rng.uniform(-2, 2, count),
            "log_scales": np.log(scale) + rng.normal(0, 0.5, (count, 3)),
            "quaternions": rng.normal(size=(count, 4))}
    # rounded as the device does
    return {name: values.astype(np.float32).astype(np.float64) for name, values in rows.items()}


class _View:
    """A renderer of CAMERA's view and its last render."""

    def __init__(self, device: Device, **options: Any) -> None:
        self.device = device
        self.renderer = Renderer(device, 1, NEAR, background=BACKGROUND, **options)
        self.camera = self.renderer.pack(CAMERA)

    def image(self, rows: Rows) -> NDArray[Any]:
        self.rows = {name: self.device.upload(values) for name, values in rows.items()}
        self.frame = self.renderer.render(self.rows, self.camera, CAMERA.width, CAMERA.height, 1)
        return self.frame.image.download()

    def gradients(self, weights: NDArray[np.float64]) -> dict[str, NDArray[np.float32]]:
        """The gradients of sum(weights * image), by the name of the field."""
        sparse = self.renderer.adjoint(self.rows, self.frame, self.device.upload(weights))
        visible, gradients = sparse.rows.download(), {}
        for name, rows in self.rows.items():
            gradients[name] = np.zeros(rows.shape, np.float32)
            gradients[name][visible] = sparse.fields[name].download()
        return gradients


def _weights() -> NDArray[np.float64]:
    """A random gradient of the image."""
    return np.random.default_rng(10).normal(size=(3, CAMERA.height, CAMERA.width))


def _footprint(rows: Rows, i: int) -> NDArray[np.float64]:
    """float64[2, 2], square pixels: the covariance of the i-th gaussian in CAMERA's image."""
    p = CAMERA.rotation @ rows["positions"][i] + CAMERA.translation
    w, x, y, z = rows["quaternions"][i] / np.linalg.norm(rows["quaternions"][i])
    turn = np.array([[1 - 2 * (y*y + z*z), 2 * (x*y - w*z), 2 * (x*z + w*y)],
                     [2 * (x*y + w*z), 1 - 2 * (x*x + z*z), 2 * (y*z - w*x)],
                     [2 * (x*z - w*y), 2 * (y*z + w*x), 1 - 2 * (x*x + y*y)]])
    slope = np.diag(CAMERA.focal) @ [[1, 0, -p[0] / p[2]], [0, 1, -p[1] / p[2]]] / p[2]
    half: NDArray[np.float64] = slope @ CAMERA.rotation @ turn * np.exp(rows["log_scales"][i])
    return half @ half.T + LOW_PASS * np.eye(2)


def culling(device: Device) -> Measured:
    """The gaussians whose footprint meets the image, but for those next to its border."""
    rows = _gaussians(1500, 0.03)
    rows["positions"] = (1.25 * rows["positions"]).astype(np.float32).astype(np.float64)
    flags, totals = cull(device, {name: device.upload(values) for name, values in rows.items()},
                         pack_camera(device, CAMERA, NEAR), (("SH_REST", 3), ("ANTIALIASED", 0)))
    kept = compact(device, flags, new_counts(device), totals=totals).download()
    opacity = 1 / (1 + np.exp(-rows["opacity_logits"]))
    means, _ = CAMERA.project(rows["positions"])
    variances = np.array([np.diag(_footprint(rows, i)) for i in range(len(means))])
    extents = np.sqrt(2 * np.log(255 * opacity)[:, None] * variances)
    inside = np.hstack([means + extents, (CAMERA.width, CAMERA.height) - means + extents]).min(1)
    seen = np.isin(np.arange(len(means)), kept)
    sure = np.abs(inside) > 0.01
    return _wrong((flags.download()[sure], inside[sure] > 0), (seen, flags.download()),
                  (totals.download().sum(keepdims=True), seen.sum(keepdims=True)))


def tile_lists(device: Device) -> Measured:
    """Specks, most of them in one tile, and a few splats that are in every tile; many depths are
    equal."""
    rng, (width, height), count = np.random.default_rng(11), (90, 70), 6000
    tiles_x, tiles_y = tile_grid(device, width, height)
    tiles = tiles_x * tiles_y
    own = np.where(rng.random(count) < 0.85, 5, rng.integers(0, tiles, count))
    large = np.flatnonzero(rng.random(count) < 0.01)
    splats = np.zeros((count, SPLAT_REALS))
    splats[:, SPLAT_MEAN:SPLAT_MEAN + 2] = device.tile * (
        np.column_stack([own % tiles_x, own // tiles_x]) + 0.5)
    splats[:, [SPLAT_CUTOFF, SPLAT_CONIC, SPLAT_CONIC + 2, SPLAT_EXTENT_Y]] = 1
    splats[large[:, None], [SPLAT_CONIC, SPLAT_CONIC + 2]] = 1e-6
    splats[large, SPLAT_EXTENT_Y] = 1e3
    depths = splats[:, SPLAT_DEPTH] = rng.integers(1, 500, count)
    order = np.argsort(depths, kind="stable").astype(np.uint32)
    pairs = bin_splats(device, device.upload(splats), new_counts(device, count),
                       device.upload(order), width, height)
    small = np.setdiff1d(np.arange(count), large)
    rows = np.concatenate([small, np.repeat(large, tiles)])
    places = np.concatenate([own[small], np.tile(np.arange(tiles), len(large))])
    sorted_places = np.lexsort((rows, depths[rows], places))
    if pairs.count != len(rows):
        return abs(pairs.count - len(rows)), 0, "pairs too many or too few"
    listed = pairs.sorted_splats.download()
    first = pairs.offsets.download()[listed]  # of a splat; its pairs are emitted by tile
    nth = np.where(np.isin(listed, large), places[sorted_places], 0)
    return _wrong((listed, rows[sorted_places]),
                  (pairs.ranges.download()[:, 1], np.cumsum(np.bincount(places, minlength=tiles))),
                  (pairs.emission_indices.download(), first + nth),
                  (np.sort(pairs.emission_indices.download()), np.arange(len(rows))))


def _evaluated(rows: Rows) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """The image float64[3, H, W] by definition, and the pixels bool[H, W] that are not close to a
    cutoff."""
    pixel = np.stack(np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))) + 0.5
    image, rest = np.zeros((3, *pixel.shape[1:])), np.ones(pixel.shape[1:])
    sure = np.ones(rest.shape, bool)
    means, depths = CAMERA.project(rows["positions"])
    for i in np.argsort(depths):
        d = pixel - means[i][:, None, None]
        q = np.einsum("ihw,ij,jhw->hw", d, np.linalg.inv(_footprint(rows, i)), d)
        alpha = np.exp(-q / 2) / (1 + np.exp(-rows["opacity_logits"][i]))
        sure &= np.abs(255 * alpha - 1) > 1e-3
        alpha[alpha < 1 / 255] = 0
        x, y, z = (rows["positions"][i] - CAMERA.position) / np.linalg.norm(
            rows["positions"][i] - CAMERA.position)
        basis = SH_C1 * np.array([-y, z, -x])
        colour = 0.5 + SH_C0 * rows["sh_constant"][i] + basis @ rows["sh_rest"][i]
        image += (rest * alpha) * np.maximum(colour, 0)[:, None, None]
        rest *= 1 - alpha
    return image + rest * np.array(BACKGROUND)[:, None, None], sure & (rest > 2e-4)


def render(device: Device) -> Measured:
    """A few gaussians, so that no pixel is opaque, against their definition."""
    rows = _gaussians(12, 0.3)
    expected, sure = _evaluated(rows)
    error = np.abs(_View(device).image(rows) - expected)[:, sure].max()
    return error, 2e-5, "largest error"


def render_adjoint(device: Device) -> Measured:
    """Every field's gradient against the difference quotient of the whole render."""
    rows, weights, view = _gaussians(12, 0.3), _weights(), _View(device, smooth_cutoff=True)
    view.image(rows)
    gradients, errors = view.gradients(weights), {}
    for name, point in rows.items():
        def weighted(values: NDArray[np.float64], name: str = name) -> float:
            return float(np.sum(weights * view.image({**rows, name: values})))
        errors[name] = _slope_error(weighted, point, gradients[name], step=1e-3)
    worst = max(errors, key=errors.__getitem__)
    return errors[worst], 3e-3, f"relative error (by {worst})"


def statistics(device: Device) -> Measured:
    """Screen gradients of the gaussians that a view saw, against their own means in pixels."""
    view = _View(device)
    view.image(_gaussians(1500, 0.1))
    sums = Statistics(device, 1500)
    found = view.renderer.adjoint(view.rows, view.frame, device.upload(_weights()),
                                  statistics=sums.sums)
    assert found.means is not None  # of one view
    expected = np.zeros(1500)
    expected[found.rows.download()] = np.linalg.norm(
        found.means.download() * (CAMERA.width / 2, CAMERA.height / 2), axis=1)
    return _relative(sums.mean_gradient(), expected), 1e-6, "relative error"


def _image_and_gradients(device: Device) -> dict[str, NDArray[Any]]:
    view = _View(device)
    image = view.image(_gaussians(1500, 0.1))
    return {"image": image, **view.gradients(_weights())}


def same_bytes(device: Device) -> Measured:
    """Image and gradients of two renders of the same gaussians."""
    first, second = (_image_and_gradients(device) for _ in range(2))
    return _wrong(*((first[name].view(np.uint32), second[name].view(np.uint32))
                    for name in first))


def forms_agree(item: Device, group: Device) -> Measured:
    """Image and gradients of 1500 gaussians; the forms may differ at pixels next to a cutoff."""
    first, second = (_image_and_gradients(device) for device in (item, group))
    errors = {name: _relative(second[name], first[name]) for name in first}
    worst = max(errors, key=errors.__getitem__)
    return errors[worst], 1e-3, f"relative difference ({worst})"


CHECKS = (("stable sort", sort), ("gather and scatter", rows_by_index),
          ("compaction", compaction), ("sums", sums), ("Adam", adam), ("statistics", statistics),
          ("culling", culling), ("tile lists", tile_lists), ("image loss", loss),
          ("image loss adjoint", loss_adjoint), ("render", render),
          ("render adjoint", render_adjoint), ("same bytes twice", same_bytes))
