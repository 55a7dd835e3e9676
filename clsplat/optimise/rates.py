"""Learning rates of the fields of gaussians, and the bias corrections of Adam."""

import numpy as np

from clsplat.constants import ONE_MINUS_BETA1, ONE_MINUS_BETA2
from clsplat.gaussians import LEARNED
from clsplat.optimise.options import OptimiseOptions

POSITION_DECAY = 0.01  # share of the rate of positions left at the last step (Kerbl et al. 2023)
# Where the last steps are averaged, gaussians move faster: positions by so many pixels of the
# photos in a step, of which this share is left at the end, and sizes, turns and colours by a factor
AVERAGED_PIXELS, AVERAGED_DECAY, AVERAGED_FACTOR = 0.1, 0.1, 3.0


def learning_rates(decay: float, extent: float, pixel: float, options: OptimiseOptions) -> dict[str, float]:
    """The learning rate of each field; that of the positions decays exponentially as `decay` goes
    from 0 to 1. It scales with the `extent` of the scene, world units, or where the last steps are
    averaged with the size of a `pixel` of the photos at the scene, world units."""
    rates = {field.name: field.rate for field in LEARNED}
    rates["positions"] *= extent * POSITION_DECAY**decay
    if options.average:
        rates = {name: AVERAGED_FACTOR * rate for name, rate in rates.items()}
        rates["positions"] = AVERAGED_PIXELS * pixel * AVERAGED_DECAY**decay
    rates["opacity_logits"] = options.opacity_rate
    return rates


def corrections(step: int) -> tuple[float, float]:
    """The bias corrections 1 / (1 - beta1^t) and 1 / sqrt(1 - beta2^t) of step t, from 1."""
    beta1, beta2 = 1 - ONE_MINUS_BETA1, 1 - ONE_MINUS_BETA2
    return 1 / (1 - beta1**step), 1 / float(np.sqrt(1 - beta2**step))
