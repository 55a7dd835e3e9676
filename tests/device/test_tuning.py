"""The table of sizes has what kernels need, for each kind of device."""

import pytest

from clsplat.constants import LANES
from clsplat.device.tuning import tuning_of


@pytest.mark.parametrize("kind, wave", [("cpu", 32), ("gpu", 32), ("gpu", 64)])
def test_sizes_suit_the_kernels(kind, wave):
    """As `#error` lines of cl/group/blend.cl and the trees of cl/include/group.h demand."""
    tuning = tuning_of(kind, wave)
    assert tuning.bucket % 32 == 0 and tuning.tile in (8, 16)
    assert tuning.tile**2 % (tuning.adjoint_waves * wave) == 0
    assert LANES % tuning.scan_group == 0 and tuning.scan_group & (tuning.scan_group - 1) == 0
    assert tuning.item_runs > 0 and tuning.group_size % wave == 0
