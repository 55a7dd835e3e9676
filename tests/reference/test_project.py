"""The reference projection: against finite differences and against values known otherwise."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import factorial, lpmv

from tests import cases
from tests.checks import adjoint_agrees
from tests.reference.bin import tiles_of
from tests.reference.project import harmonics, project, project_adjoint

OUTPUTS = ("means", "conics", "opacities", "colours", "depths")


def splats(case, **options):
    return project(case["rows"], case["camera"], case["degree"], case["near"], **options)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize(
    "name",
    [
        "plain",
        "ragged",
        "one",
        "degree_0",
        "degree_1",
        "degree_2",
        "lower_degree_active",
        "giants",
        "grazing",
        "specks",
    ],
)
def test_adjoint_agrees_with_differences(name, antialiased):
    case = cases.gaussians(name)
    camera, degree, near = case["camera"], case["degree"], case["near"]

    def function(rows):
        result = project(rows, camera, degree, near, antialiased=antialiased)
        return {key: result[key] for key in OUTPUTS}

    def adjoint(rows, grads):
        return project_adjoint(rows, camera, degree, near, antialiased=antialiased, grads=grads)

    assert splats(case)["visible"].any()
    for seed in range(3):
        adjoint_agrees(function, adjoint, case["rows"], seed, step=1e-4, what=f"project {name}")


@pytest.mark.parametrize(
    "ratio, clamped",
    [
        ((-0.5, 0.1), (-0.32, 0.1)),
        ((0.9, 0.1), (0.72, 0.1)),
        ((-0.31, 0.41), (-0.31, 0.41)),
        ((0.1, -1.5), (0.1, -1.14)),
        ((0.1, 0.6), (0.1, 0.42)),
        ((0.71, -1.13), (0.71, -1.13)),
    ],
)
def test_jacobian_is_clamped_beside_the_image(ratio, clamped):
    """x: -(10/50 + 0.15 40/50) to 30/50 + 0.12; y: -(24/25 + 0.15 30/25) to 6/25 + 0.18."""
    camera = {
        "width": 40,
        "height": 30,
        "fx": 50,
        "fy": 25,
        "cx": 10,
        "cy": 24,
        "rotation": np.eye(3),
        "translation": np.zeros(3),
    }
    rows = {
        "positions": np.array([[4 * ratio[0], 4 * ratio[1], 4]]),
        "log_scales": np.zeros((1, 3)),
        "quaternions": np.array([[1.0, 0, 0, 0]]),
        "opacity_logits": np.zeros(1),
        "sh_constant": np.zeros((1, 3)),
        "sh_rest": np.zeros((1, 0, 3)),
    }
    result = project(rows, camera, 0, 0.1)
    jacobian = np.array([[50, 0, -50 * clamped[0]], [0, 25, -25 * clamped[1]]]) / 4
    (a, b), (_, c) = np.linalg.inv(jacobian @ jacobian.T + 0.3 * np.eye(2))
    np.testing.assert_allclose(result["conics"], [[a, b, c]])
    np.testing.assert_allclose(result["means"], [[50 * ratio[0] + 10, 25 * ratio[1] + 24]])


def test_splat_of_an_isotropic_gaussian_on_the_axis():
    rows = {
        "positions": np.array([[0.0, 0, 4]]),
        "log_scales": np.log([[0.1, 0.1, 0.1]]),
        "quaternions": np.array([[1.0, 2, 3, 4]]),
        "opacity_logits": np.zeros(1),
        "sh_constant": np.array([[1.0, 0, -3]]),
        "sh_rest": np.zeros((1, 0, 3)),
    }
    camera = cases.camera(40, 30)
    result = project(rows, camera, 0, 0.1)
    variance = (35 * 0.1 / 4) ** 2 + 0.3
    np.testing.assert_allclose(result["means"], [[20, 15]])
    np.testing.assert_allclose(result["conics"], [[1 / variance, 0, 1 / variance]], atol=1e-15)
    np.testing.assert_allclose(result["colours"], [[0.5 + 0.28209479177387814, 0.5, 0]])
    np.testing.assert_allclose(result["opacities"], [0.5])
    np.testing.assert_allclose(result["cutoffs"], [2 * np.log(127.5)])
    np.testing.assert_allclose(result["extents"], np.sqrt(2 * np.log(127.5) * variance) * np.ones((1, 2)))
    mip = project(rows, camera, 0, 0.1, antialiased=True)
    np.testing.assert_allclose(mip["opacities"], [0.5 * (variance - 0.3) / variance])


def test_conic_is_the_inverse_of_the_projected_covariance():
    case = cases.gaussians("ragged")
    rows, camera, result = case["rows"], case["camera"], splats(case)
    body = Rotation.from_quat(rows["quaternions"][:, [1, 2, 3, 0]]).as_matrix()
    covariance = body @ (np.exp(2 * rows["log_scales"])[:, :, None] * np.swapaxes(body, 1, 2))
    inside = result["visible"] & (result["means"] > 0).all(1)
    inside &= (result["means"] < [camera["width"], camera["height"]]).all(1)
    assert inside.sum() > 5
    for k in np.flatnonzero(inside):
        derivative = np.array(
            [
                (_pixel(rows["positions"][k] + d, camera) - _pixel(rows["positions"][k] - d, camera)) / 2e-5
                for d in 1e-5 * np.eye(3)
            ]
        ).T
        inverse = np.linalg.inv(derivative @ covariance[k] @ derivative.T + 0.3 * np.eye(2))
        a, b, c = result["conics"][k]
        np.testing.assert_allclose([[a, b], [b, c]], inverse, rtol=1e-6, atol=1e-9)


def _pixel(position, camera):
    x, y, z = camera["rotation"] @ position + camera["translation"]
    return np.array([camera["fx"] * x / z + camera["cx"], camera["fy"] * y / z + camera["cy"]])


def test_determinant_survives_needles():
    """A needle across the view: across it there is the low-pass only, whatever its length. By the
    difference of products, the determinant would lose every digit here."""
    rows = cases.gaussians("one")["rows"]
    rows["positions"] = np.array([[0.0, 0, 4]])
    rows["log_scales"] = np.log([[1e5, 1e-5, 1e-5]])
    rows["quaternions"] = np.array([[np.cos(0.3), 0, 0, np.sin(0.3)]])
    conic = project(rows, cases.camera(16, 16), 0, 0.1)["conics"][0]
    assert conic[0] + conic[2] == pytest.approx(1 / 0.3, rel=1e-8)


def test_harmonics_are_the_orthonormal_ones():
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(20, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    azimuth = np.arctan2(direction[:, 1], direction[:, 0])
    basis = harmonics(direction, 3)[0]
    for degree in range(4):
        for order in range(-degree, degree + 1):
            m = abs(order)
            norm = (2 * degree + 1) / (4 * np.pi) * factorial(degree - m) / factorial(degree + m)
            norm *= 2 if order else 1
            wave = np.sin(m * azimuth) if order < 0 else np.cos(m * azimuth)
            value = np.sqrt(norm) * lpmv(m, degree, direction[:, 2]) * wave
            np.testing.assert_allclose(
                basis[:, degree * (degree + 1) + order], value, atol=1e-12, err_msg=f"degree {degree}, order {order}"
            )


def test_what_is_not_visible_is_zero_and_gets_no_gradient():
    case = cases.gaussians("near_plane")
    result = splats(case)
    assert result["visible"].tolist() == [True, True, False, False, False, False] * 4
    grads = {key: np.ones_like(result[key]) for key in OUTPUTS}
    rows_grads = project_adjoint(case["rows"], case["camera"], case["degree"], case["near"], grads=grads)
    for values in (*(result[key] for key in OUTPUTS), *rows_grads.values()):
        assert not values[~result["visible"]].any() and values[result["visible"]].any()


def test_quaternion_length_changes_nothing_but_zero_hides():
    case = cases.gaussians("quaternions")
    result = splats(case)
    assert not result["visible"][0::4].any()
    assert result["visible"][1::4].any() and result["visible"][2::4].any()
    unit = case["rows"]["quaternions"] / np.maximum(
        np.linalg.norm(case["rows"]["quaternions"], axis=1, keepdims=True), 1e-30
    )
    again = splats({**case, "rows": {**case["rows"], "quaternions": unit}})
    shown = result["visible"]
    np.testing.assert_allclose(again["conics"][shown], result["conics"][shown], rtol=1e-12)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["positions", "log_scales", "quaternions", "opacity_logits", "sh_constant", "sh_rest"])
def test_poison_stays_in_its_row(name, value):
    case = cases.gaussians("plain")
    index = (3,) + (0,) * (case["rows"][name].ndim - 1)
    rows = cases.poisoned(case["rows"], name, index, value)
    clean, result = splats(case), splats({**case, "rows": rows})
    others = np.arange(30) != 3
    for key in clean:
        assert np.isfinite(result[key]).all()
        np.testing.assert_array_equal(result[key][others], clean[key][others])


@pytest.mark.parametrize("name", cases.SCENES)
def test_every_case_is_finite_and_has_its_shapes(name):
    case = cases.gaussians(name)
    result = splats(case)
    grads = project_adjoint(
        case["rows"],
        case["camera"],
        case["degree"],
        case["near"],
        grads={key: np.ones_like(result[key]) for key in OUTPUTS},
    )
    assert result["visible"].any() or name == "empty"
    for key, values in case["rows"].items():
        np.testing.assert_array_equal(values, np.float32(values))
        assert grads[key].shape == values.shape and np.isfinite(grads[key]).all()


def test_no_pixel_outside_the_extent_reaches_the_cutoff():
    """`tiles_of` and the kernels look inside the extent only."""
    result = splats(cases.gaussians("ragged"))
    for k in np.flatnonzero(result["visible"]):
        mean, conic, cutoff = (result[key][k] for key in ("means", "conics", "cutoffs"))
        exact = tiles_of(mean, conic, result["extents"][k], cutoff, 4, 3)
        assert exact == tiles_of(mean, conic, np.array([1e3, 1e3]), cutoff, 4, 3)


def test_tiles_of_a_needle_follow_the_diagonal():
    conic = np.array([1 / 0.3, -1 / 0.3, 1 / 0.3]) + [1e-4, 0, 1e-4]
    tiles = tiles_of(np.array([32.0, 32.0]), conic, np.array([40.0, 40.0]), 9.0, 4, 4)
    assert tiles == {(k, k) for k in range(4)} | {pair for k in range(3) for pair in ((k, k + 1), (k + 1, k))}
