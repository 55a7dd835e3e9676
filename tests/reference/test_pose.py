"""The gradient by a pose: against finite differences of a whole render, in float64."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests import cases
from tests.checks import adjoint_agrees
from tests.kernels.chain import depth_order, size_of
from tests.reference import pose as reference
from tests.reference.blend import blend, blend_adjoint
from tests.reference.project import project

DEPTH = 3.7


def rendered(case, camera, antialiased):
    splats = project(case["rows"], camera, case["degree"], case["near"], antialiased=antialiased)
    return splats, depth_order(splats)


@pytest.mark.parametrize("name, antialiased", [("plain", False), ("degree_1", True), ("degree_2", False)])
def test_agrees_with_differences_of_a_render(name, antialiased):
    case = cases.gaussians(name, seed=4, count=12, width=30, height=20)
    case["rows"]["opacity_logits"] -= 1  # no pixel may end early: that is a step
    size, background = size_of(case), case["background"]

    def image(point):
        camera = reference.apply(case["camera"], point["pose"], DEPTH)
        splats, order = rendered(case, camera, antialiased)
        drawn, _, depth = blend(splats, order, *size, background, smooth=True, with_depth=True)
        return {"image": drawn, "depth": depth}

    def adjoint(point, cotangents):
        camera = reference.apply(case["camera"], point["pose"], DEPTH)
        splats, order = rendered(case, camera, antialiased)
        grads = blend_adjoint(splats, order, *size, background, cotangents["image"], cotangents["depth"], smooth=True)
        sums = reference.terms(case["rows"], camera, case["degree"], case["near"], antialiased, grads=grads).sum(axis=0)
        return {"pose": reference.gradient(case["camera"], point["pose"], DEPTH, sums)}

    for seed in range(3):
        pose = np.random.default_rng(seed).normal(0, 0.03, 6)
        adjoint_agrees(image, adjoint, {"pose": pose}, seed, what=name)
        adjoint_agrees(image, adjoint, {"pose": 0 * pose}, seed, step=1e-7, what=f"{name} at 0")


def test_the_exponential_is_a_rotation_and_has_its_derivative():
    turn, small = np.array([0.3, -0.5, 0.2]), 1e-6 * np.array([1, 2, -1])
    matrix, jacobian = reference.exponential(turn)
    assert np.allclose(matrix, Rotation.from_rotvec(turn).as_matrix(), atol=1e-14)
    moved = reference.exponential(turn + small)[0] @ matrix.T
    assert np.allclose(Rotation.from_matrix(moved).as_rotvec(), jacobian @ small, atol=1e-11)


def test_a_shift_moves_the_centre_along_the_cameras_axes():
    camera = cases.camera(40, 30)
    moved = reference.apply(camera, np.array([0, 0, 0, 0, 0, 0.5]), 2.0)
    assert np.array_equal(moved["rotation"], camera["rotation"])
    assert np.allclose(moved["translation"], camera["translation"] - [0, 0, 1])
