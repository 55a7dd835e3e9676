"""Changes of views without a block's gaussians: exact, or bounds that decide as exact ones do."""

import numpy as np
import pytest

from clsplat.city.visibility import change
from clsplat.evaluation.metrics import ssim


def pictures(seed, noise, rows=slice(None), size=(96, 64)):
    """Two pictures that differ by noise in some rows."""
    rng = np.random.default_rng(seed)
    one = rng.random((*size, 3)).astype(np.float32)
    other = one.copy()
    other[rows] = np.clip(other[rows] + noise * rng.standard_normal(other[rows].shape), 0, 1)
    return one, other


PARTS = [slice(None), slice(0, 9), slice(90, None), slice(40, 44), np.s_[30:60, :9],
         np.s_[80:, 60:], np.s_[50, 40]]


@pytest.mark.parametrize("rows", PARTS)
@pytest.mark.parametrize("noise", [0.001, 0.02, 0.3])
def test_a_bound_decides_as_the_exact_change_does(rows, noise):
    one, other = pictures(0, noise, rows)
    exact = 1 - ssim(one, other)
    for threshold in np.linspace(0, 2 * exact, 40):
        found = change(one, other, threshold)
        assert found <= exact * (1 + 1e-6) + 1e-12 and (found > threshold) == (exact > threshold)
    assert change(one, other, 2 * exact) == pytest.approx(exact, rel=1e-6, abs=1e-12)
    assert change(one, one, 0.003) == 0


def test_few_rows_are_compared_where_these_suffice(monkeypatch):
    """An image with less than two windows of rows is compared as a whole."""
    compared = []
    monkeypatch.setattr("clsplat.city.visibility.ssim",
                        lambda one, other: compared.append(len(one)) or ssim(one, other))
    change(*pictures(0, 0.3, size=(400, 64)), 0.003)
    change(*pictures(0, 0.3, size=(20, 64)), 0.003)
    change(*pictures(0, 0.3, slice(100, 110), (400, 64)), 1)
    assert compared == [50, 20, 22, 30]
