"""A rendered depth against an adjacent photo: value, gradients, and what counts as valid."""

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.loss.reproject import pack_pairs, reproject
from tests import cases
from tests.checks import close
from tests.data.view_pairs import view_pair
from tests.kernels import chain
from tests.reference import reproject as reference

COLOUR = cases.single(np.array([[0.9, 0.1, -0.05, 0.02], [0.0, 1.1, 0.05, -0.03], [0.1, 0.0, 0.8, 0.01]]))
WEIGHT = 0.125
# of the view and of the neighbour; rows around the 128 items of a group
SIZES = (
    ((1, 1), (48, 40)),
    ((7, 5), (9, 8)),
    ((61, 37), (48, 40)),
    ((48, 40), (61, 37)),
    ((127, 9), (127, 9)),
    ((128, 9), (30, 5)),
    ((129, 9), (40, 90)),
    ((5, 130), (5, 130)),
)


def an_input(size, other_size=None, seed=0, **pose):
    """A dict of `view_pair`: depths some percent off, transmittance 0 to 0.7, photos with noise,
    and no pixel that single precision may decide otherwise (these are left empty)."""
    cameras, photo, neighbour, z = view_pair(size, other_size, seed, **pose)
    rng = np.random.default_rng(seed)
    transmittance = cases.single(rng.uniform(0, 0.7, z.shape))
    transmittance.flat[0] = 0.25
    depth = cases.single(z * rng.uniform(0.95, 1.05, z.shape) * (1 - transmittance))
    transmittance[reference.fragile_pixels(depth, transmittance, neighbour, cameras)] = 1
    photo, neighbour = (
        np.clip(values + rng.integers(-20, 21, values.shape), 0, 255).astype(np.uint8) for values in (photo, neighbour)
    )
    return {
        "depth": depth,
        "transmittance": transmittance,
        "photo": photo,
        "neighbour": neighbour,
        "cameras": cameras,
        "colour": COLOUR,
    }


def camera(values):
    return Camera(
        values["width"],
        values["height"],
        (values["fx"], values["fy"]),
        (values["cx"], values["cy"]),
        values["rotation"],
        values["translation"],
    )


def run(device, values, weight=WEIGHT, geometry=None):
    """(sums, grad_depth, grad_transmittance) as numpy arrays."""
    if geometry is None:
        geometry = pack_pairs(device, [map(camera, values["cameras"])]).download()[0]
    # the pair stands between others that would be noticed
    geometries = device.upload(np.stack([np.full(12, 7.0), geometry, np.full(12, 7.0)]))
    colours = device.upload(np.stack([np.full((3, 4), 9.0), values["colour"], np.zeros((3, 4))]))
    arrays = (device.upload(values[name]) for name in ("depth", "transmittance", "photo", "neighbour"))
    return tuple(
        array.download() for array in reproject(device, *arrays, geometries, colours.reshaped(3, 12), 1, weight)
    )


def check(device, values, what):
    """Against the reference; returns how many pixels are valid."""
    squares, valid, *expected = reference.reproject(
        values["depth"],
        values["transmittance"],
        values["photo"] / 255,
        values["neighbour"] / 255,
        values["cameras"],
        values["colour"],
    )
    sums, *grads = run(device, values)
    close(sums, [squares.sum(), valid.sum()], chain.precision_of(device), f"{what}: sums")
    for name, grad, expected_grad in zip(("depth", "transmittance"), grads, expected):
        close(grad, WEIGHT * expected_grad, chain.precision_of(device), f"{what}: gradient of {name}")
    return valid.sum()


def masked(photo, valid):
    return np.concatenate([photo, valid[None] * np.uint8(255)])


def test_masked_pixels_and_samples_are_not_valid(device):
    values = an_input((61, 37), (48, 40), move=(0.1, -0.05, 0.1))
    sums, *grads = run(device, values)
    valid = cases.mask(61, 37, 1)
    some, *some_grads = run(device, values | {"photo": masked(values["photo"], valid)})
    assert 0 < some[1] < sums[1]
    for grad, some_grad in zip(grads, some_grads):
        assert not some_grad[~valid].any()
        close(some_grad * some[1], np.where(valid, grad, 0) * sums[1], chain.precision_of(device), "mask")
    other = np.ones((40, 48), bool)
    none, *_ = run(device, values | {"neighbour": masked(values["neighbour"], other)})
    assert np.array_equal(none, sums)
    other[20, 24] = False  # a texel has a share in samples of a square of two pixels
    fewer, *_ = run(device, values | {"neighbour": masked(values["neighbour"], other)})
    assert sums[1] - 12 < fewer[1] < sums[1]
    other = cases.mask(48, 40, 2)
    neighbours = values["neighbour"], np.where(other, values["neighbour"], 0)
    first, second = (run(device, values | {"neighbour": masked(each, other)}) for each in neighbours)
    assert 0 < first[0][1] < sums[1] and all(map(np.array_equal, first, second))


@pytest.mark.double
@pytest.mark.oclgrind
@pytest.mark.parametrize("size, other_size", SIZES, ids=str)
def test_value_and_gradients(device, size, other_size):
    valid = check(device, an_input(size, other_size, move=(0.1, -0.05, 0.1)), f"{size}")
    assert valid > 0.2 * size[0] * size[1]


def test_towards_and_away_and_turned_about_the_axis(device):
    for pose in (dict(move=(0.1, 0.2, 2)), dict(move=(0.1, 0.2, -2)), dict(turn=(0.1, 0, 1.5)), dict(turn=(0, 0, 0))):
        assert check(device, an_input((48, 40), seed=1, **pose), f"{pose}") > 200


@pytest.mark.parametrize(
    "case",
    [
        "empty",
        "neighbour of one column",
        "of one row",
        "of one pixel",
        "behind",
        "negative depth",
        "no depth",
        "not a number",
    ],
)
def test_nothing_valid_leaves_zeros(device, case):
    other_size = {"neighbour of one column": (1, 9), "of one row": (9, 1), "of one pixel": (1, 1)}
    away = dict(move=(0.1, -0.05, 9))  # the neighbour sees what has a depth of 0 or less, too
    pose = {"behind": dict(turn=(0, np.pi, 0)), "negative depth": away, "no depth": away}
    values = an_input((33, 17), other_size.get(case), **pose.get(case, {}))
    changes = {
        "empty": ("transmittance", 1),
        "negative depth": ("depth", -1),
        "no depth": ("depth", 0),
        "not a number": ("depth", np.nan),
    }
    if case in changes:
        name, value = changes[case]
        values[name][:] = value
    assert not np.any(np.concatenate([array.ravel() for array in run(device, values)]))


@pytest.mark.parametrize("name", ["depth", "transmittance"])
def test_poison_stays_with_its_pixel(device, name):
    values = an_input((17, 9), seed=6)
    values["transmittance"][4, 7] = 0.25
    before = run(device, values)
    for label, poison in cases.POISON.items():
        with np.errstate(over="ignore"):
            sums, *grads = run(device, cases.poisoned(values, name, (4, 7), poison))
        assert np.isfinite(sums).all() and abs(sums[1] - before[0][1]) <= 1, label
        for grad, expected in zip(grads, before[1:]):
            assert np.isfinite(grad).all(), f"{name} = {label}"
            actual, expected_grad = grad * sums[1], expected * before[0][1]
            actual[4, 7] = expected_grad[4, 7] = 0
            close(actual, expected_grad, chain.precision_of(device), f"{name} = {label}")


@pytest.mark.parametrize(
    "name, index", [("colour", (1, 2)), ("colour", (0, 3)), ("geometry", 0), ("geometry", 8), ("geometry", 11)]
)
def test_poison_in_what_all_pixels_share_is_never_nan(device, name, index):
    values = an_input((17, 9), seed=7)
    values["geometry"] = pack_pairs(device, [map(camera, values["cameras"])]).download()[0]
    for label, poison in cases.POISON.items():
        changed = cases.poisoned(values, name, index, poison)
        results = run(device, changed, geometry=changed["geometry"])
        assert np.isfinite(results[1:]).all(), f"{name}[{index}] = {label}"
        assert not np.isnan(results[0]).any(), f"{name}[{index}] = {label}"
        with np.errstate(over="ignore"):
            overflows = not np.isfinite(device.real.type(poison) ** 2)
        assert not (overflows and name == "colour" and results[0].any())


@pytest.mark.slow
@pytest.mark.one_in(2)
def test_through_the_renderer_to_the_gaussians(double_device):
    """The loss of a render by differences, against the chain of adjoints. The neighbour is a ramp,
    of which bilinear samples have no kinks."""
    device = double_device
    case = chain.small_scene(3, count=40, width=30, height=20)
    case["rows"]["log_scales"] += 0.5
    line, column = np.mgrid[:30, :45]
    ramp = np.stack([2 * column + 3 * line, 5 * column, 200 - 4 * line]).astype(np.uint8)
    photo = np.random.default_rng(3).integers(0, 256, (3, 20, 30), np.uint8)
    first = chain.camera_of(case)
    other = Camera(45, 30, (40.0, 44.0), (22.0, 15.5), first.rotation, first.translation + [0.3, -0.1, 0.4])
    shared = (
        device.upload(photo),
        device.upload(ramp),
        pack_pairs(device, [(first, other)]),
        device.upload(np.reshape(COLOUR, (1, 12))),
        0,
        WEIGHT,
    )
    renderer, rows, frame = chain.render(device, case, with_depth=True, smooth_cutoff=True)
    assert frame.blended.transmittance.download().min() > 2e-4  # none ends early: that is a step
    sums, *grads = reproject(device, frame.blended.depth, frame.blended.transmittance, *shared)
    count = sums.download()[1]
    assert count > 100
    gradients = chain.gradients_by_row(renderer.adjoint(rows, frame, device.zeros(frame.image.shape), *grads), case)
    rng = np.random.default_rng(4)
    direction = {name: rng.normal(size=v.shape) * (np.abs(v) + 0.1) for name, v in case["rows"].items()}

    def loss(distance):
        moved = chain.upload_rows(device, {name: v + distance * direction[name] for name, v in case["rows"].items()})
        drawn = renderer.render(moved, frame.camera, *frame.size, case["degree"], True).blended
        squares, valid = reproject(device, drawn.depth, drawn.transmittance, *shared)[0].download()
        assert valid == count
        return WEIGHT * squares / valid

    step = 1e-6
    near, far = (loss(k * step) - loss(-k * step) for k in (1, 2))
    by_difference = (8 * near - far) / (12 * step)
    terms = np.concatenate([(gradients[name] * direction[name]).ravel() for name in direction])
    size = max(abs(by_difference), np.sqrt(np.sum(terms**2)))
    assert abs(by_difference - terms.sum()) < 1e-6 * size, (by_difference, terms.sum())
    assert size > 1e-3
