"""What the photos of a scene determine in the SIG schedule: its levels, the most gaussians
of each, and how many steps are worth taking."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from clsplat.config.option import origin_of
from clsplat.errors import InputError
from clsplat.schedule.plan import SceneFacts

if TYPE_CHECKING:
    from clsplat.options import ScheduledOptions

LEVELS = (5.0, 4.0, 3.0, 2.0, 1.0)
LEVELS_OF_BLOCK = (2.0, 1.0)
SMALLEST_SIDE = 64  # pixels: what smaller images teach, the next level learns at once
TILE = 16  # pixels
ROUND_STEPS = (100, 200)  # least and most between rounds of growth
LEAST_STEPS = 2 * ROUND_STEPS[0]  # of a level: in fewer, what it begins has no time to settle
COLOUR_ERROR = 0.0072  # of full brightness: the standard error of a gaussian's colour
LEAST_PIXELS_A_GAUSSIAN = 15.0  # where photos agree: it has 59 parameters, a pixel 3 values
USUAL_DISAGREEMENT = 0.03  # where the sparse model does not tell which photos show a point
USUAL_PHOTOS = 5.0  # that show a point
MOST_A_PHOTO = 150  # steps for each training photo; after more, held-out photos get worse
ENOUGH = 7000  # steps, however few the photos are, if they agree
AGREEING = 0.036  # of full brightness: photos of a place that differ by more allow fewer steps
POWER = 3  # of that ratio; see docs/evidence/schedules.md
FEWEST, FEWEST_A_PHOTO = 1000, 50  # steps, however much the photos disagree


def level_shares(levels: Sequence[float], together: float | str) -> tuple[float, ...]:
    """The share of the run that each of the coarser levels may take, in proportion to its
    resolution.

    Parameters
    ----------
    levels : down-sampling factors, from coarse to fine.
    together : of all coarser levels; auto: the finest, too, has its share in proportion.
    """
    *coarser, finest = (1 / level for level in levels)
    if isinstance(together, str):
        together = sum(coarser) / (sum(coarser) + finest)
    return tuple(together * resolution / sum(coarser) for resolution in coarser)


def pixels_per_gaussian(options: "ScheduledOptions", facts: SceneFacts) -> float:
    """The least number of training pixels for each gaussian; 0: any number.

    The mean of n colours that scatter by s has a standard error of s / sqrt(n).
    """
    requested: str | float = options.pixels_per_gaussian
    if isinstance(requested, float):
        return requested
    scatter = facts.disagreement()
    if math.isnan(scatter):
        scatter = USUAL_DISAGREEMENT
    return max(LEAST_PIXELS_A_GAUSSIAN, (scatter / COLOUR_ERROR) ** 2)


def most_gaussians(options: "ScheduledOptions", facts: SceneFacts, level: float) -> float:
    """Number of gaussians that the training pixels of a level can determine; may be inf."""
    each = pixels_per_gaussian(options, facts)
    return math.floor(facts.pixels / level**2 / each) if each else math.inf


def chosen_levels(options: "ScheduledOptions", size: tuple[int, int],
                  candidates: tuple[float, ...] = LEVELS, least: int = SMALLEST_SIDE
                  ) -> tuple[float, ...]:
    """The down-sampling factors of a training.

    The default ones leave out sides below `least`, and the coarsest levels for which there is
    no time.

    Parameters
    ----------
    options : with scaled steps.
    size : (width, height) of the smallest training image, pixels.
    candidates : the default ones.
    least : pixels; less in a block, where the smallest of many windows says little of the others.

    Raises
    ------
    InputError : a requested factor would make an image smaller than a tile.
    """
    levels, side = options.levels, min(size)
    if levels:
        if int(side / levels[0]) < TILE and levels[0] > 1:
            raise InputError(
                f"{origin_of(options, 'levels')}: level {levels[0]:g} would train on images of "
                f"{int(size[0] / levels[0])} x {int(size[1] / levels[0])} pixels, less than a tile "
                f"of {TILE}; give smaller --levels, or larger photos by a smaller --downscale or a "
                "larger --max-resolution")
        return levels
    levels = tuple(level for level in candidates if level == 1 or side / level >= least)
    while (shares := level_shares(levels, options.level_share)) and (
            shares[0] * options.iterations < LEAST_STEPS):
        levels = levels[1:]
    return levels


def most_steps(options: "ScheduledOptions", facts: SceneFacts, photos: int) -> int:
    """The most steps that are worth taking with so many training photos; 0: any number.

    Held-out photos get worse after these, as gaussians then learn what the photos disagree about.
    The mean over n photos of a place keeps 1 / sqrt(n) of their disagreement.
    """
    requested: str | float = options.visits
    if isinstance(requested, float):
        return max(1, round(requested * photos)) if requested else 0
    shown_in = USUAL_PHOTOS if math.isnan(facts.shown_in) else facts.shown_in
    left = facts.disagreement() * math.sqrt(USUAL_PHOTOS / shown_in)
    share = (AGREEING / left) ** POWER if left > AGREEING else 1.0  # 1 for a nan
    return max(FEWEST, FEWEST_A_PHOTO * photos, round(share * max(ENOUGH, MOST_A_PHOTO * photos)))
