"""Learning rates over a run."""

from clsplat.gaussians import FIELDS

POSITION_DECAY = 0.01  # of the position rate, reached at the last step (Kerbl et al. 2023)


def learning_rates(step, steps, extent):
    """Field name -> learning rate at `step` of `steps` (from 0).

    Positions move in world units, so their rate scales with the scene's extent; it decays
    exponentially, the others stay.
    """
    rates = {field.name: field.rate for field in FIELDS}
    rates["positions"] *= extent * POSITION_DECAY ** (step / steps)
    return rates
