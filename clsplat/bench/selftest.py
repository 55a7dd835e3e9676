"""A correctness self-test for any driver, in a few seconds: `check(device)`.

An error of a driver or compiler shows here and not as a bad model after hours: the kernels of which
every training consists run in both forms, in single precision. Their results are compared with
`selftest.npz`, which the float64 reference of the tests made (`tests/reference/selftest.py`), with
numpy, or with themselves.
"""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.camera import Camera
from clsplat.constants import (
    NO_ROW,
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
from clsplat.primitives.compact import compact, new_counts
from clsplat.primitives.gather import gather, scatter
from clsplat.primitives.sort import stable_sort
from clsplat.rendering.bin import bin_splats, tile_grid
from clsplat.rendering.pipeline import Renderer
from clsplat.rendering.project import Gradients

STORED = Path(__file__).with_suffix(".npz")
NEAR, DEGREE, SSIM_WEIGHT = 0.1, 1, 0.2
CAMERA = Camera(61, 43, (55.0, 52.0), (30.0, 22.0), np.eye(3), np.array([0.1, -0.2, 0.3]))
BACKGROUND = (0.1, 0.3, 0.2)
RATES = {field.name: field.rate for field in LEARNED}
LATER = 0.5  # the gradient of the second step of Adam, as a multiple of the first one's

# name, whether it passed, and the measured error with its bound or what the driver raised
Result = tuple[str, bool, str]
Measured = tuple[float, float, str]  # error, its bound, its kind


def check(device: Device) -> list[Result]:
    """The results of every check, in both kernel forms on the device of `device`."""
    return [result for form in ("item", "group")
            for result in check_form(Device(device.handle, form=form))]


def check_form(device: Device) -> list[Result]:
    """The same as `check`, in the form and precision in which the device is open."""
    return [_result(f"{name}, {device.form} form", test, device) for name, test in CHECKS]


def _result(name: str, test: Callable[[Device], Measured], device: Device) -> Result:
    try:
        error, bound, kind = test(device)
    except Exception as raised:  # a driver may raise anything, and that is the result
        return name, False, " ".join(f"{type(raised).__name__}: {raised}".split())[:300]
    return name, bool(error <= bound), f"{kind} {error:.2g}, bound {bound:g}"


@cache
def stored() -> dict[str, NDArray[Any]]:
    """Inputs and expected results.

    Returns
    -------
    in_FIELD : float32[N, ...], gaussians of degree 1, some of which CAMERA does not see.
    visible : bool[N], those that it sees; none is close to its border.
    image : float32[3, H, W], their image.
    photo : uint8[3, H, W]
    loss : float64, the loss of `image` against `photo`.
    grad_image : float32[3, H, W], its gradient.
    weights : int8[3, H, W], a gradient of the image; 0 at pixels close to a cutoff.
    grad_FIELD : float32[N, ...], the gradients of sum(weights * image).
    screen : float32[N], the norm of the gradient by the mean in NDC.
    out_FIELD : float32[N, ...], gaussians after two steps of Adam.
    """
    with np.load(STORED, allow_pickle=False) as file:
        return dict(file)


def _relative(actual: ArrayLike, expected: ArrayLike) -> float:
    """Root mean square of the difference over that of the expected values."""
    actual, expected = np.asarray(actual, np.float64), np.asarray(expected, np.float64)
    return float(np.linalg.norm(actual - expected) / np.linalg.norm(expected))


def _worst(errors: dict[str, float], bound: float) -> Measured:
    """The largest of the relative errors by field."""
    worst = max(errors, key=errors.__getitem__)
    return errors[worst], bound, f"relative error ({worst})"


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


# --- a training step


class _Step:
    """The view of CAMERA, rendered and differentiated."""

    def __init__(self, device: Device) -> None:
        self.device = device
        self.renderer = Renderer(device, DEGREE, NEAR, background=BACKGROUND)
        self.rows = {field.name: device.upload(stored()[f"in_{field.name}"]) for field in LEARNED}
        self.frame = self.renderer.render(self.rows, self.renderer.pack(CAMERA), CAMERA.width,
                                          CAMERA.height, DEGREE)

    def adjoint(self, **options: Any) -> Gradients:
        """The gradients of sum(weights * image)."""
        return self.renderer.adjoint(self.rows, self.frame, self.device.upload(
            stored()["weights"].astype(np.float32)), **options)

    def results(self) -> dict[str, NDArray[Any]]:
        """The image, and the gradients by the name of the field, 0 for rows that are not seen."""
        gradients = self.adjoint()
        visible, results = gradients.rows.download(), {"image": self.frame.image.download()}
        for name, rows in self.rows.items():
            results[name] = np.zeros(rows.shape, np.float32)
            results[name][visible] = gradients.fields[name].download()
        return results


def render(device: Device) -> Measured:
    """The image, but for pixels where rounding may decide whether a splat is drawn."""
    error = np.abs(_Step(device).frame.image.download() - stored()["image"])
    return float(error[stored()["weights"] != 0].max()), 2e-5, "largest error"


def loss(device: Device) -> Measured:
    """The loss of the stored image."""
    totals, _ = image_loss(device, device.upload(stored()["image"]),
                           device.upload(stored()["photo"]), SSIM_WEIGHT)
    value, _, _ = loss_value(totals, stored()["photo"].size, SSIM_WEIGHT)
    return abs(value - float(stored()["loss"])), 1e-5, "error"


def loss_adjoint(device: Device) -> Measured:
    """The gradient of the loss."""
    _, grad = image_loss(device, device.upload(stored()["image"]),
                         device.upload(stored()["photo"]), SSIM_WEIGHT)
    return _relative(grad.download(), stored()["grad_image"]), 1e-4, "relative error"


def render_adjoint(device: Device) -> Measured:
    """Every field's gradient."""
    found = _Step(device).results()
    return _worst({field.name: _relative(found[field.name], stored()[f"grad_{field.name}"])
                   for field in LEARNED}, 1e-3)


def statistics(device: Device) -> Measured:
    """Screen gradients."""
    sums = Statistics(device, len(stored()["screen"]))
    _Step(device).adjoint(statistics=sums.sums)
    return _relative(sums.mean_gradient(), stored()["screen"]), 1e-3, "relative error"


def adam(device: Device) -> Measured:
    """Two steps of the seen rows, of which the first one is marked as not finite."""
    visible = np.flatnonzero(stored()["visible"]).astype(np.uint32)
    rows = {field.name: device.upload(stored()[f"in_{field.name}"]) for field in LEARNED}
    engine, seen = DeviceAdam(device, rows), device.upload(visible)
    finite = device.upload(np.concatenate([[NO_ROW], visible[1:]]).astype(np.uint32))
    for number, factor in ((1, 1.0), (2, LATER)):
        fields = {field.name: device.upload(np.float32(factor) * stored()[f"grad_{field.name}"][
            visible]) for field in LEARNED}
        gradients = Gradients(fields, device.zeros((len(visible), 2)), finite, seen,
                              new_counts(device, len(visible)))
        engine.step(rows, gradients, number, RATES,
                    {field.name: field.width(DEGREE) for field in LEARNED})
    return _worst({field.name: _relative(
        rows[field.name].download() - stored()[f"in_{field.name}"],
        stored()[f"out_{field.name}"] - stored()[f"in_{field.name}"]) for field in LEARNED}, 5e-3)


def same_bytes(device: Device) -> Measured:
    """Image and gradients of two renders of the same gaussians."""
    first, second = (_Step(device).results() for _ in range(2))
    return _wrong(*((first[name].view(np.uint32), second[name].view(np.uint32))
                    for name in first))


CHECKS = (("stable sort", sort), ("gather and scatter", rows_by_index),
          ("compaction", compaction), ("tile lists", tile_lists), ("render", render),
          ("image loss", loss), ("image loss adjoint", loss_adjoint),
          ("render adjoint", render_adjoint), ("statistics", statistics), ("Adam", adam),
          ("same bytes twice", same_bytes))
