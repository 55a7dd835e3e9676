"""Learning rates: those of 3DGS; only the positions decay, the opacity rate is an option."""

import pytest

from clsplat.gaussians import LEARNED
from clsplat.optimise.options import OptimiseOptions
from clsplat.optimise.rates import learning_rates

STEADY = {"sh_constant": 2.5e-3, "sh_rest": 1.25e-4, "log_scales": 5e-3, "quaternions": 1e-3}


@pytest.mark.parametrize("decay, position", [(0, 1.6e-4), (0.5, 1.6e-5), (1, 1.6e-6), (0.25, 1.6e-4 * 10**-0.5)])
@pytest.mark.parametrize("opacity_rate", [5e-2, 0.02])
def test_positions_decay_exponentially_with_the_extent(decay, position, opacity_rate):
    rates = learning_rates(decay, 7.0, 0.02, OptimiseOptions(opacity_rate=opacity_rate, average=0.0))
    assert list(rates) == [field.name for field in LEARNED]
    assert rates.pop("positions") == pytest.approx(7.0 * position)
    assert rates == {**STEADY, "opacity_logits": opacity_rate}


def test_with_an_average_steps_are_larger_and_positions_move_by_pixels():
    usual, first, last = (
        learning_rates(decay, 7.0, 0.02, OptimiseOptions(average=share))
        for decay, share in ((0, 0.0), (0, 0.2), (1, 0.2))
    )
    assert first.pop("positions") == pytest.approx(0.1 * 0.02)
    assert last.pop("positions") == pytest.approx(0.01 * 0.02)
    assert (
        first
        == last
        == {name: rate * (1 if name == "opacity_logits" else 3) for name, rate in usual.items() if name != "positions"}
    )
