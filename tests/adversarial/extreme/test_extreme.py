"""Every case of the extreme set has its outcome, and stays within its bound."""

import numpy as np
import pytest

from tests.adversarial.extreme.cases import CASES
from tests.adversarial.extreme.measure import bound_of, measure


@pytest.mark.parametrize("case", [
    pytest.param(case, id=case.name, marks=[pytest.mark.slow] * case.slow) for case in CASES])
@pytest.mark.one_in(10)
def test_case(device, case):
    found, scene = measure(device, case), case.scene()
    assert np.array_equal(found.drawn, scene["drawn"]), (
        f"{case.name}: rows {np.flatnonzero(found.drawn != scene['drawn'])} drawn or culled "
        f"against expectation ({case.outcome})")
    assert np.array_equal(found.skipped, scene["skipped"]), (
        f"{case.name}: gradients of rows {np.flatnonzero(found.skipped)} skipped, not of "
        f"{np.flatnonzero(scene['skipped'])} ({case.outcome})")
    assert found.counted == found.skipped.sum(), f"{case.name}: counted {found.counted}"
    assert found.compared > 0.5, f"{case.name}: thresholds decide too many pixels"
    errors = {"image": (found.image, case.image),
              **{f"gradient of {name}": (error, case.gradient)
                 for name, error in found.gradients.items()}}
    for name, (error, bound) in errors.items():
        bound = bound_of(device, bound)
        assert error.value <= bound, (
            f"{case.name}: {name} is off by {error.value:.3g} where {bound:.3g} is allowed; "
            f"the worst element {error.worst}")
