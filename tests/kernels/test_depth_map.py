"""A rendered depth against a depth map: value, gradients, and what does not count."""

import numpy as np
import pytest

from clsplat.loss.depth_map import compare_depth
from tests import cases
from tests.checks import close
from tests.kernels.chain import precision_of
from tests.reference.depth_map import compare_depth as reference
from tests.reference.test_depth_map import an_input

WEIGHT = 0.125
# rows around the 128 items of a group
SIZES = ((1, 1), (7, 5), (127, 9), (128, 9), (129, 9), (5, 130))


def run(device, arrays):
    return tuple(
        array.download() for array in compare_depth(device, *(device.upload(values) for values in arrays), WEIGHT)
    )


@pytest.mark.double
@pytest.mark.oclgrind
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_value_and_gradients(device, size):
    arrays = [cases.single(values) for values in an_input(*size)]
    _, by_depth, by_transmittance, error = reference(*arrays)
    sums, *grads = run(device, arrays)
    counted = ~np.isnan(error)
    close(sums, [np.abs(error[counted]).sum(), counted.sum()], precision_of(device), f"{size}")
    for name, grad, expected in zip(("depth", "T"), grads, (by_depth, by_transmittance)):
        close(grad, WEIGHT * expected, precision_of(device), f"{size}: by {name}")


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, -1.0, 0.0])
def test_maps_without_a_depth_and_renders_that_are_not_finite(device, bad):
    depth, transmittance, known = (cases.single(values) for values in an_input(20, 10))
    known[known == 0] = 3.0
    known[4, 4] = bad
    sums, *grads = run(device, (depth, transmittance, known))
    assert not any(grad[4, 4] for grad in grads) and np.isfinite(sums).all()
    known[4, 4], depth[5, 5] = 3.0, np.nan
    sums, *grads = run(device, (depth, transmittance, known))
    assert not any(grad[5, 5] for grad in grads) and np.isfinite(sums).all()
