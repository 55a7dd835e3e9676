"""The reference of depth maps against differences, and what it does with wrong depths."""

import numpy as np
import pytest

from tests.checks import adjoint_agrees
from tests.reference.depth_map import compare_depth


def an_input(width, height, seed=0):
    """depth, transmittance and known depths, some of them 0, and pixels that are not covered."""
    rng = np.random.default_rng(seed)
    known = rng.uniform(2, 9, (height, width))
    transmittance = rng.uniform(0, 0.7, known.shape)
    transmittance[np.abs(transmittance - 0.5) < 1e-3] = 0.3
    depth = known * rng.uniform(0.8, 1.2, known.shape) * (1 - transmittance)
    known[rng.random(known.shape) < 0.2] = 0
    return depth, transmittance, known


@pytest.mark.parametrize("size", [(1, 1), (9, 7)])
def test_gradients_agree_with_differences(size):
    depth, transmittance, known = an_input(*size)
    adjoint_agrees(
        lambda point: {"loss": np.array(compare_depth(point["d"], point["t"], known)[0])},
        lambda point, grads: dict(
            zip("dt", (by * grads["loss"] for by in compare_depth(point["d"], point["t"], known)[1:3]))
        ),
        {"d": depth, "t": transmittance},
        what=f"depth map {size}",
    )


def test_a_wrong_depth_pulls_no_more_than_a_right_one():
    known = np.full((1, 3), 5.0)
    _, by_depth, _, error = compare_depth(np.array([[5.5, 50.0, 5.0]]), np.zeros((1, 3)), known)
    assert by_depth[0, 1] < 1.01 * by_depth[0, 0] and by_depth[0, 2] == 0
    assert error[0] == pytest.approx([0.1, 9, 0])
