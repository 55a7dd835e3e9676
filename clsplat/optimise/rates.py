"""Learning rates over a run."""

from clsplat.gaussians import LEARNED

POSITION_DECAY = 0.01  # of the position rate, reached at the last step (Kerbl et al. 2023)


def learning_rates(decay, extent, opacity_rate):
    """Field name -> learning rate.

    Positions move in world units, so their rate scales with the scene's extent; it falls
    exponentially with `decay`, 0 to 1. The others stay.
    """
    rates = {field.name: field.rate for field in LEARNED}
    rates["positions"] *= extent * POSITION_DECAY**decay
    rates["opacity_logits"] = opacity_rate
    return rates
