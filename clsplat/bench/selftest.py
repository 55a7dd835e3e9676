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

from clsplat import constants
from clsplat.camera import Camera
from clsplat.densify.scores import Statistics
from clsplat.device import Array, Device
from clsplat.gaussians import LEARNED
from clsplat.loss.image_loss import image_loss, loss_value
from clsplat.optimise.adam import DeviceAdam
from clsplat.primitives.compact import compact, new_counts
from clsplat.primitives.gather import gather
from clsplat.primitives.sort import stable_sort
from clsplat.rendering.bin import bin_splats, tile_grid
from clsplat.rendering.pipeline import Frame, Renderer
from clsplat.rendering.project import Gradients

STORED = Path(__file__).with_suffix(".npz")
NEAR, DEGREE, SSIM_WEIGHT = 0.1, 1, 0.2
CAMERA = Camera(61, 43, (55.0, 52.0), (30.0, 22.0), np.eye(3), np.array([0.1, -0.2, 0.3]))
BACKGROUND = (0.1, 0.3, 0.2)
RATES = {field.name: field.rate for field in LEARNED}
LATER = 0.5  # the gradient of the second step of Adam, as a multiple of the first one's

Compared = list[tuple[ArrayLike, ArrayLike]]  # what the device computed, and what is expected


def check(device: Device) -> list[tuple[str, bool, str]]:
    """The results of every check, in both kernel forms on the device of `device`, in its sizes.

    A result is its name, whether it passed, and the error or what the driver raised.
    """
    return [
        _result(Device(device.handle, form=form, tuning=device.tuning), *row)
        for form in ("item", "group")
        for row in CHECKS
    ]


def _result(device: Device, name: str, bound: float, test: Callable[[Device], Compared]) -> tuple[str, bool, str]:
    name = f"{name}, {device.form} form"
    try:
        error = max(_error(*pair) for pair in test(device))
    except Exception as raised:  # a driver may raise anything, and that is the result
        return name, False, " ".join(f"{type(raised).__name__}: {raised}".split())[:300]
    return name, error <= bound, f"relative error {error:.2g}, bound {bound:g}"


def _error(found: ArrayLike, expected: ArrayLike) -> float:
    """Root mean square of the difference over that of the expected values; never NaN."""
    found, expected = np.asarray(found, np.float64), np.asarray(expected, np.float64)
    if found.shape != expected.shape:
        return np.inf
    error = float(np.linalg.norm(found - expected) / np.linalg.norm(expected))
    return error if error == error else np.inf


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


def rows_by_number(device: Device) -> Compared:
    """Sort keys of which many are equal, copy rows, and choose rows by flags."""
    rng = np.random.default_rng(1)
    keys = rng.choice(rng.integers(0, 2**32, 5000, dtype=np.uint32), 30_011)
    rows, flags = rng.random((len(keys), 3), np.float32), keys & 1
    sorted_keys, order = stable_sort(device, device.upload(keys), new_counts(device, len(keys)))
    expected = np.argsort(keys, kind="stable")
    copied = gather(device, device.upload(rows), device.upload(expected.astype(np.uint32)))
    kept = compact(device, device.upload(flags), new_counts(device))
    return [
        (sorted_keys.download(), keys[expected]),
        (order.download(), expected),
        (copied.download(), rows[expected]),
        (kept.download(), np.flatnonzero(flags)),
    ]


def tile_lists(device: Device) -> Compared:
    """Specks, most of them in one tile; many depths are equal."""
    rng, (width, height), count = np.random.default_rng(11), (90, 70), 6000
    tiles_x, tiles_y = tile_grid(device, width, height)
    own = np.where(rng.random(count) < 0.85, 5, rng.integers(0, tiles_x * tiles_y, count))
    splats = np.zeros((count, constants.SPLAT_REALS))
    splats[:, constants.SPLAT_MEAN : constants.SPLAT_MEAN + 2] = device.tile * (
        np.column_stack([own % tiles_x, own // tiles_x]) + 0.5
    )
    for column in (constants.SPLAT_CUTOFF, constants.SPLAT_CONIC, constants.SPLAT_CONIC + 2, constants.SPLAT_EXTENT_Y):
        splats[:, column] = 1
    depths = splats[:, constants.SPLAT_DEPTH] = rng.integers(1, 500, count)
    order = np.argsort(depths, kind="stable").astype(np.uint32)
    pairs = bin_splats(device, device.upload(splats), new_counts(device, count), device.upload(order), width, height)
    listed = pairs.sorted_splats.download()
    return [
        (listed, np.lexsort((depths, own))),
        (pairs.ranges.download()[:, 1], np.cumsum(np.bincount(own, minlength=len(pairs.tiles)))),
        (pairs.emission_indices.download(), pairs.offsets.download()[listed]),
    ]


def _rendered(device: Device) -> tuple[Renderer, dict[str, Array], Frame]:
    renderer = Renderer(device, DEGREE, NEAR, background=BACKGROUND)
    rows = {field.name: device.upload(stored()[f"in_{field.name}"]) for field in LEARNED}
    return renderer, rows, renderer.render(rows, renderer.pack(CAMERA), CAMERA.width, CAMERA.height, DEGREE)


def render(device: Device) -> Compared:
    """The image, but for pixels where rounding may decide whether a splat is drawn."""
    sure = stored()["weights"] != 0
    return [(_rendered(device)[2].image.download()[sure], stored()["image"][sure])]


def loss(device: Device) -> Compared:
    """The loss of the stored image, and its gradient."""
    totals, grad = image_loss(device, device.upload(stored()["image"]), device.upload(stored()["photo"]), SSIM_WEIGHT)
    value, _, _ = loss_value(totals, stored()["photo"].size, SSIM_WEIGHT)
    return [(value, stored()["loss"]), (grad.download(), stored()["grad_image"])]


def render_adjoint(device: Device) -> Compared:
    """The gradients of sum(weights * image) by every field, and by the places on the screen."""
    renderer, rows, frame = _rendered(device)
    sums = Statistics(device, len(stored()["screen"]))
    gradients = renderer.adjoint(
        rows, frame, device.upload(stored()["weights"].astype(np.float32)), statistics=sums.sums
    )
    visible = gradients.rows.download()
    return [
        (sums.mean_gradient(), stored()["screen"]),
        *((gradients.fields[name].download(), stored()[f"grad_{name}"][visible]) for name in rows),
    ]


def adam(device: Device) -> Compared:
    """Two steps of the seen rows, of which the first one is marked as not finite."""
    visible = np.flatnonzero(stored()["visible"]).astype(np.uint32)
    rows = {field.name: device.upload(stored()[f"in_{field.name}"]) for field in LEARNED}
    engine, seen = DeviceAdam(device, rows), device.upload(visible)
    finite = device.upload(np.concatenate([[constants.NO_ROW], visible[1:]]).astype(np.uint32))
    for number, factor in ((1, 1.0), (2, LATER)):
        fields = {
            field.name: device.upload(np.float32(factor) * stored()[f"grad_{field.name}"][visible]) for field in LEARNED
        }
        gradients = Gradients(fields, device.zeros((len(visible), 2)), finite, seen, new_counts(device, len(visible)))
        engine.apply(rows, gradients, engine.numbers(number, RATES), DEGREE)
    return [
        (rows[name].download() - before, stored()[f"out_{name}"] - before)
        for name in rows
        for before in [stored()[f"in_{name}"]]
    ]


def same_bytes(device: Device) -> Compared:
    """Image and gradients of two renders of the same gaussians."""
    return [
        (found, again)
        for test in (render, render_adjoint)
        for (found, _), (again, _) in zip(test(device), test(device))
    ]


# name, largest error, test
CHECKS: tuple[tuple[str, float, Callable[[Device], Compared]], ...] = (
    ("sort, gather and compaction", 0, rows_by_number),
    ("tile lists", 0, tile_lists),
    ("render", 2e-5, render),
    ("image loss and its adjoint", 1e-4, loss),
    ("render adjoint", 1e-3, render_adjoint),
    ("Adam", 5e-3, adam),
    ("same bytes twice", 0, same_bytes),
)
