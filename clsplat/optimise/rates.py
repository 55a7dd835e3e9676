"""Learning rates over a run."""

from clsplat.gaussians import LEARNED

POSITION_DECAY = 0.01  # the share of it left at the last step (Kerbl et al. 2023)


def learning_rates(decay: float, extent: float, opacity_rate: float) -> dict[str, float]:
    """The learning rate of each field; that of the positions decays exponentially as `decay` goes
    from 0 to 1, and scales with the extent of the scene, world units, in which positions move."""
    rates = {field.name: field.rate for field in LEARNED}
    rates["positions"] *= extent * POSITION_DECAY**decay
    rates["opacity_logits"] = opacity_rate
    return rates
