"""Learning rates: those of 3DGS, only the positions' decaying."""

import pytest

from clsplat.optimise.rates import learning_rates

STEADY = {"sh_constant": 2.5e-3, "sh_rest": 1.25e-4, "opacity_logits": 5e-2, "log_scales": 5e-3,
          "quaternions": 1e-3}


@pytest.mark.parametrize("step, position", [
    (0, 1.6e-4), (15000, 1.6e-5), (30000, 1.6e-6), (7500, 1.6e-4 * 10**-0.5)])
def test_positions_decay_exponentially_with_the_extent(step, position):
    rates = learning_rates(step, 30000, 7.0)
    assert rates.pop("positions") == pytest.approx(7.0 * position)
    assert rates == STEADY
