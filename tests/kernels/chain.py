"""What the tests of rendering share: cases on the device, and the same chain by the reference."""

import functools
from contextlib import contextmanager

import numpy as np

from clsplat.camera import Camera
from clsplat.constants import COUNT_VISIBLE
from clsplat.rendering.pipeline import Renderer
from tests import cases
from tests.checks import close
from tests.reference.blend import blend, blend_adjoint, fragile_pixels
from tests.reference.project import project, project_adjoint

UNWRITTEN = 2**32 - 7
SUM_NAMES = ("means", "conics", "opacities", "colours", "depths")


def precision_of(device):
    return "double" if device.real == np.float64 else "float"


@contextmanager
def longer_arrays(device, monkeypatch, length, spare):
    """Arrays of this length have `spare` slots past their end, which must stay UNWRITTEN; yields
    those that are made."""
    empty, made = device.empty, []

    def longer(shape, dtype=None):
        if shape != length:
            return empty(shape, dtype)
        made.append(empty(length + spare, dtype))
        made[-1].fill(UNWRITTEN)
        return made[-1].narrow(length)

    with monkeypatch.context() as patch:
        patch.setattr(device, "empty", longer)
        yield made


def upload_rows(device, rows):
    return {name: device.upload(values) for name, values in rows.items()}


def camera_of(case):
    c = case["camera"]
    return Camera(
        c["width"],
        c["height"],
        (c["fx"], c["fy"]),
        (c["cx"], c["cy"]),
        c["rotation"],
        c["translation"],
        orthographic=c.get("orthographic", False),
    )


def size_of(case):
    return case["camera"]["width"], case["camera"]["height"]


def stored_degree(case):
    return round(np.sqrt(case["rows"]["sh_rest"].shape[1] + 1)) - 1


def renderer_of(device, case, pair_limit=None, **options):
    renderer = Renderer(device, stored_degree(case), case["near"], background=case["background"], **options)
    if pair_limit is not None:
        renderer.most_pairs = lambda *_: pair_limit
    return renderer


def render(device, case, rows=None, with_depth=False, exposure=None, features=None, depth_percent=0, **options):
    """(renderer, rows on the device, frame) of a case."""
    renderer = renderer_of(device, case, **options)
    rows = upload_rows(device, case["rows"] if rows is None else rows)
    frame = renderer.render(
        rows,
        renderer.pack(camera_of(case)),
        *size_of(case),
        case["degree"],
        with_depth,
        exposure=exposure,
        depth_percent=depth_percent,
        features=None if features is None else device.upload(features),
    )
    return renderer, rows, frame


def depth_order(splats):
    visible = np.flatnonzero(splats["visible"])
    return visible[np.argsort(splats["depths"][visible].astype(np.float32), kind="stable")]


def gradients_by_row(gradients, case):
    """Downloaded gradients as arrays like the rows, zero where a view did not see the gaussian."""
    number = gradients.counts.download()[COUNT_VISIBLE]  # of more, where the frame has a room
    visible = gradients.rows.download()[:number]
    result = {}
    for name, values in case["rows"].items():
        result[name] = np.zeros(values.shape)
        seen = gradients.fields[name].download()[:number]
        if name == "sh_rest":  # bands that are not active are not written
            seen[:, case["degree"] * (case["degree"] + 2) :] = 0
        result[name][visible] = seen
    return result


def close_gradients(actual, expected, case, precision, what):
    """Quaternions may have any length, and their gradients are as the inverse of it."""
    for name, values in expected.items():
        scale = 1
        if name == "quaternions":
            scale = np.linalg.norm(case["rows"][name], axis=1, keepdims=True)
        close(actual[name] * scale, values * scale, precision, f"{what}: gradient of {name}")


@functools.cache
def reference_of(name, antialiased, **changes):
    """A case by the reference, once for all devices: the case, the visible gaussians in depth
    order, image, depth, pixels that lower precision may decide otherwise, random cotangents that
    are zero there, and the gradients by row."""
    case = cases.gaussians(name, **changes)
    size, arguments = size_of(case), (case["camera"], case["degree"], case["near"])
    splats = project(case["rows"], *arguments, antialiased=antialiased)
    order = depth_order(splats)
    fragile = fragile_pixels(splats, order, *size)
    rng = np.random.default_rng(1)
    cotangents = [np.where(fragile, 0, rng.normal(size=(*channels, *fragile.shape))) for channels in ((3,), (), ())]
    image, _, depth = blend(splats, order, *size, case["background"], with_depth=True)
    by_splat = blend_adjoint(splats, order, *size, case["background"], *cotangents)
    gradients = project_adjoint(case["rows"], *arguments, antialiased=antialiased, grads=by_splat)
    return case, order, image, depth, fragile, cotangents, gradients


def agrees_with_reference(device, name, antialiased, **changes):
    """Render a case with depth, and back from random cotangents, against the reference."""
    case, order, image, depth, fragile, cotangents, expected = reference_of(name, antialiased, **changes)
    renderer, rows, frame = render(device, case, with_depth=True, antialiased=antialiased)
    precision = precision_of(device)
    assert sorted(frame.visible.download()) == sorted(order), f"{name}: visible gaussians"
    close(np.where(fragile, image, frame.image.download()), image, precision, f"{name}: image")
    close(np.where(fragile, depth, frame.blended.depth.download()), depth, precision, f"{name}: depth")
    gradients = renderer.adjoint(rows, frame, *map(device.upload, cotangents))
    assert np.array_equal(gradients.rows.download(), frame.visible.download())
    assert renderer.skipped.download()[0] == 0
    close_gradients(gradients_by_row(gradients, case), expected, case, precision, name)


def pack_splats(splats, order):
    """Rows of 12 (cl/include/splat.h) of reference splats in `order`; cutoffs and extents follow
    from opacities and conics."""
    conics, opacities = splats["conics"][order], splats["opacities"][order]
    a, b, c = conics.T
    cutoffs = 2 * np.log(255 * opacities)
    extents = np.sqrt(cutoffs * a / (a * c - b * b))
    return np.column_stack(
        [splats["means"][order], opacities, cutoffs, conics, extents, splats["colours"][order], splats["depths"][order]]
    )


def grads_of_sums(sums, conics, channels=3):
    """Gradients by splat (names of the reference) from the adjoint's sums[V, S]."""
    opacities, x, y, xx, xy, yy = sums[:, :6].T
    depths = sums[:, 6 + max(channels, 2) :]
    a, b, c = conics.T
    return {
        "colours": sums[:, 6 : 6 + channels],
        "opacities": opacities,
        "means": np.stack([a * x + b * y, b * x + c * y], axis=1),
        "conics": -np.stack([xx / 2, xy, yy / 2], axis=1),
        "depths": depths.sum(axis=1),
    }


def small_scene(seed=0, count=24, **size):
    return cases.gaussians("degree_1", seed=seed, count=count, **size)
