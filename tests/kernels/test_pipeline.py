"""The whole chain of rendering: gaussians to image and back."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clsplat.constants import SH_C0
from clsplat.errors import ShapeError
from tests import cases
from tests.checks import close
from tests.kernels import chain

ANTIALIASED = ("plain", "needles", "grazing")


@pytest.mark.parametrize(
    "name, antialiased",
    [pytest.param(name, False, marks=pytest.mark.slow if name == "many" else ()) for name in cases.SCENES]
    + [(name, True) for name in ANTIALIASED],
)
@pytest.mark.one_in(5)
def test_image_and_gradients(device, name, antialiased):
    chain.agrees_with_reference(device, name, antialiased)


@pytest.mark.oclgrind
def test_a_small_scene(device):
    chain.agrees_with_reference(device, "degree_1", False, count=12)


@pytest.mark.slow
@pytest.mark.one_in(2)
def test_features_that_are_colours_make_the_same_frame(device):
    """Of degree 0 over black: the image, the gradients by shapes, also in bands, and those by the
    features, which are those by the harmonics but for their factor."""
    case = {**cases.gaussians("plain"), "degree": 0, "background": np.zeros(3)}
    renderer, rows, plain = chain.render(device, case)
    colours = np.maximum(0, 0.5 + SH_C0 * case["rows"]["sh_constant"])
    features, camera = device.upload(colours), renderer.pack(chain.camera_of(case))
    grad, results = device.upload(cotangents(case)[0]), []
    for limit in (plain.pairs.count, plain.pairs.count // 2):
        renderer.most_pairs = lambda *_, limit=limit: limit
        frame = renderer.render(rows, camera, *chain.size_of(case), 0, features=features)
        results.append((frame, renderer.adjoint(rows, frame, grad, with_pose=True)))
    (frame, actual), (banded, same) = results
    assert len(banded.bands) > 1
    assert np.array_equal(banded.image.download(), frame.image.download())
    assert np.array_equal(same.features.download(), actual.features.download())
    precision, expected = chain.precision_of(device), renderer.adjoint(rows, plain, grad, with_pose=True)
    close(frame.image.download(), plain.image.download(), precision, "image")
    for name in ("positions", "opacity_logits", "log_scales", "quaternions"):
        close(actual.fields[name].download(), expected.fields[name].download(), precision, name)
    drawn = colours[frame.visible.download()] > 0
    close(drawn * SH_C0 * actual.features.download(), expected.fields["sh_constant"].download(), precision, "features")
    assert not actual.fields["sh_constant"].download().any()
    close(actual.by_pose(), expected.by_pose(), precision, "pose")


@pytest.mark.parametrize("channels", [0, 17])
def test_features_of_too_many_channels_are_refused(float_device, channels):
    case = cases.gaussians("plain")
    with pytest.raises(ShapeError, match="1 to 16 channels"):
        chain.render(float_device, case, features=np.zeros((len(case["rows"]["positions"]), channels)))


def cotangents(case, seed=0):
    width, height = chain.size_of(case)
    rng = np.random.default_rng(seed)
    return (rng.normal(size=(3, height, width)), *rng.normal(size=(2, height, width)))


def back(device, renderer, rows, frame, case):
    return renderer.adjoint(rows, frame, *map(device.upload, cotangents(case)))


@pytest.mark.parametrize(
    "antialiased, seeds",
    [(False, range(4)), (True, range(20, 22)), pytest.param(False, range(4, 20), marks=pytest.mark.slow)],
)
@pytest.mark.one_in(4)
def test_adjoint_is_the_transposed_derivative(double_device, antialiased, seeds):
    """<J v, w> = <v, J^T w>, with J v by central differences of fourth order."""
    for seed in seeds:
        case = chain.small_scene(seed, count=16, width=30, height=20)
        case["rows"]["opacity_logits"] -= 1  # no pixel may end early: that is a step
        rng = np.random.default_rng(seed)
        renderer, rows, frame = chain.render(
            double_device, case, with_depth=True, smooth_cutoff=True, antialiased=antialiased
        )
        assert frame.blended.transmittance.download().min() > 2e-4
        gradients = chain.gradients_by_row(back(double_device, renderer, rows, frame, case), case)
        direction = {
            name: rng.normal(size=values.shape) * (np.abs(values) + 0.1) for name, values in case["rows"].items()
        }
        step = 1e-6
        near, far = (
            weighted(renderer, case, direction, k * step) - weighted(renderer, case, direction, -k * step)
            for k in (1, 2)
        )
        by_difference = (8 * near - far) / (12 * step)
        terms = np.concatenate([(gradients[n] * direction[n]).ravel() for n in direction])
        size = max(abs(by_difference), np.sqrt(np.sum(terms**2)))
        assert abs(by_difference - terms.sum()) < 1e-6 * size, (
            f"seed {seed}: the difference quotient is {by_difference:.12g}, the adjoint gives {terms.sum():.12g}"
        )


def weighted(renderer, case, direction, distance):
    """The rendering of the rows moved along a direction, weighted by the cotangents."""
    rows = chain.upload_rows(
        renderer.device, {name: values + distance * direction[name] for name, values in case["rows"].items()}
    )
    frame = renderer.render(
        rows, renderer.pack(chain.camera_of(case)), *chain.size_of(case), case["degree"], with_depth=True
    )
    drawn = frame.image, frame.blended.depth, frame.blended.transmittance
    return sum(np.sum(a.download() * b) for a, b in zip(drawn, cotangents(case)))


def rendered_bytes(device, case):
    renderer, rows, frame = chain.render(device, case, with_depth=True)
    gradients = back(device, renderer, rows, frame, case)
    return (
        frame.image.download(),
        frame.blended.depth.download(),
        gradients.means.download(),
        *chain.gradients_by_row(gradients, case).values(),
    )


def assert_same(first, second):
    assert all(np.array_equal(a, b) for a, b in zip(first, second))


def test_the_same_bytes_every_time_and_for_every_group_size(device, monkeypatch):
    case = cases.gaussians("degree_1", count=150)
    first = rendered_bytes(device, case)
    assert_same(first, rendered_bytes(device, case))
    for group in (32, 64):
        monkeypatch.setattr(device, "group_size", group)
        assert_same(first, rendered_bytes(device, case))


@pytest.mark.slow
@pytest.mark.one_in(2)
def test_the_gradient_by_the_pose_agrees_with_differences(double_device):
    case = cases.gaussians("plain")
    renderer, rows, frame = chain.render(double_device, case, smooth_cutoff=True)
    weights, camera = cotangents(case)[0], chain.camera_of(case)
    actual = renderer.adjoint(rows, frame, double_device.upload(weights), with_pose=True).by_pose()

    def loss(change):
        rotation = Rotation.from_rotvec(change[:3]).as_matrix() @ camera.rotation
        moved = replace(camera, rotation=rotation, translation=-rotation @ (camera.position + change[3:]))
        image = renderer.render(rows, renderer.pack(moved), *frame.size, case["degree"]).image
        return (image.download() * weights).sum()

    expected = [(loss(step) - loss(-step)) / 2e-5 for step in 1e-5 * np.eye(6)]
    assert actual == pytest.approx(expected, rel=1e-5)
