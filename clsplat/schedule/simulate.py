"""A schedule driven to its end without a model, to predict levels and numbers of gaussians.

We assume that each level ends at the earliest test that its schedule allows, and that the number of
gaussians densified in a round is proportional to a power of the photos' fine detail. The four
numbers of that were fitted to runs of 7000 steps on caliterra (half and full size), boruszyn, lund
and the city. There the most gaussians are predicted to 1.00 to 1.05 of what came under sig, 0.73 to
1.42 under constant, 0.52 to 1.01 under dash, 1.00 to 1.26 under taming; other scenes may be off by
more. `--max-gaussians` makes the end certain. `python -m tools.studies.predicted` compares.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from clsplat.schedule.plan import Schedule
from clsplat.schedule.sig import VARIANTS

ASKS = 0.4  # share of the gaussians at most that asks for more in a round of growth
# of a level's training pixels, the share that asks for a gaussian in a round: the power of their
# detail, until they are sharp, and of it what is left when the position rate has decayed
ASKED, SHARP, POWER, SETTLES = 0.009, 0.0125, 3, 0.03


@dataclass(frozen=True)
class Segment:
    """Equal steps in a row.

    Attributes
    ----------
    steps : their number.
    level : down-sampling factor.
    gaussians : in the model.
    regularises : whether they compare with source views.
    """

    steps: int
    level: float
    gaussians: int
    regularises: bool


def simulate(schedule: Schedule, detail: Callable[[float], float] | None = None) -> list[Segment]:
    """The segments of a whole run.

    Parameters
    ----------
    schedule : a new one, which is used up.
    detail : called with a level, gives the mean difference of a photo, at that level and in 0..1,
        to its blocks of 2 x 2 pixels; None takes photos for sharp.
    """
    options = schedule.options
    flat = {f"{variant}_mean": 1.0 for variant in VARIANTS}
    count, taken = schedule.facts.count, []
    pixels = schedule.facts.pixels
    for iteration in range(1, options.iterations + 1):
        plan = schedule.plan(iteration)
        kind = plan.level, count, plan.regularises > 0
        if taken and taken[-1][0] == kind:
            taken[-1][1] += 1
        else:
            taken.append([kind, 1])
        if plan.grows:
            share = 1.0 if detail is None else min(1.0, (detail(plan.level) / SHARP) ** POWER)
            asked = ASKED * share * pixels / plan.level**2 * SETTLES**plan.decay
            count = _grown(schedule, iteration, count, asked)
        if iteration % schedule.observe_every == 0:
            schedule.observe(iteration, flat)
    return [Segment(steps, *kind) for kind, steps in taken]


def largest(segments: Sequence[Segment]) -> int:
    """The most gaussians at a time."""
    return max(segment.gaussians for segment in segments)


def _grown(schedule, iteration, count, asked):
    """Gaussians after a round of growth, as `training.step.Step` chooses them."""
    above = int(min(asked, ASKS * count))
    target, limit = schedule.target(iteration, count, above), schedule.options.max_gaussians
    if limit:
        target = min(limit, limit if target is None else target)
    if target is None:
        return count + above
    room = max(0, target - count)
    return count + (min(above, room) if schedule.selection == "threshold" else room)
