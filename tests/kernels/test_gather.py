"""Rows by index."""

import numpy as np
import pytest

from clsplat.primitives.gather import gather
from tests.reference.gather import gather as expected_gather


@pytest.mark.oclgrind
@pytest.mark.parametrize("shape", [(), (1,), (3,), (15, 3), (0, 3)], ids=str)
def test_rows_by_index(device, shape):
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(50, *shape)).astype(device.real)
    for count in (0, 1, device.group_size - 1, device.group_size + 1):
        index = rng.integers(0, 50, count).astype(np.uint32)  # some repeat
        result = gather(device, device.upload(rows), device.upload(index))
        assert np.array_equal(result.download(), expected_gather(rows, index))
