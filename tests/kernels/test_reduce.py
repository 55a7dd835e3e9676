"""Sums of columns: exact enough, and the same bytes every time."""

import numpy as np
import pytest

from clsplat.primitives.reduce import add_to, sum_columns
from tests.checks import close
from tests.kernels.chain import precision_of
from tests.reference import reduce as reference


@pytest.mark.oclgrind
@pytest.mark.parametrize("width", [1, 2, 5])
def test_sums(device, width):
    group = device.scan_group
    for count in (0, 1, group - 1, group, group + 1, 3 * group + 7):
        rows = np.random.default_rng(count).normal(1, 1, (count, width))
        totals = sum_columns(device, device.upload(rows)).download()
        close(totals, rows.sum(axis=0), precision_of(device), f"{count} rows")


def test_many_terms_do_not_drift(float_device):
    """A plain loop in single precision is off by 2.7e-3 here."""
    rows = np.full((300_001, 1), np.float32(0.1))
    total = sum_columns(float_device, float_device.upload(rows)).download()[0]
    assert abs(total / (300_001 * np.float64(np.float32(0.1))) - 1) < 1e-4


@pytest.mark.parametrize("count", [1, 200, 5000])
def test_groups_of_any_size_add_in_the_same_order(float_device, monkeypatch, count):
    device = float_device
    rows = device.upload(np.random.default_rng(3).normal(size=(count, 3)))
    expected = sum_columns(device, rows).download()
    for group in (32, 128):
        assert group < device.scan_group
        with monkeypatch.context() as patch:
            patch.setattr(device, "scan_group", group)
            assert sum_columns(device, rows).download().tobytes() == expected.tobytes(), group


@pytest.mark.oclgrind
@pytest.mark.parametrize("shape", [(1,), (3, 17, 5), (0, 4), (70_001,)], ids=str)
def test_arrays_are_added_in_place(device, shape):
    totals, values = np.random.default_rng(4).normal(size=(2, *shape))
    sums, added = device.upload(totals), device.upload(values)
    add_to(device, sums, added)
    close(sums.download(), reference.add_to(totals, values), precision_of(device), "sums")
    assert np.array_equal(added.download(), values.astype(device.real))
