"""Drives a schedule to its end without a model, to predict levels and numbers of gaussians.

We assume that each level ends at the earliest test that its schedule allows, and that the number of
gaussians densified in a round is proportional to a power of the photos' fine detail. The four
constants were fitted to runs of 7000 steps on caliterra (half and full size), boruszyn, lund and
the city. There the prediction of the largest number of gaussians was 1.00 to 1.05 of the actual one
with sig, 0.73 to 1.42 with constant, 0.52 to 1.01 with dash, 1.00 to 1.26 with taming. The share of
dense points was fitted on sheffield_all and ochota; on three other sets and the city the largest
number was 0.86 to 1.38 of the actual one, the last 0.63 to 1.02. Other scenes may be off by more.
`--max-gaussians` bounds it.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

from clsplat.schedule.plan import FEWEST_ENTERING, USUAL_PHOTOS, Schedule
from clsplat.schedule.sig_options import VARIANTS

MOST_DENSIFIED = 0.4  # share of the gaussians that a round of growth densifies at most
# In a round, a level densifies PER_PIXEL gaussians for each of its training pixels, times the POWER
# of detail / SHARP (at most 1), times SETTLED to the power of the position rate's decay. If more
# than USUAL_PHOTOS show a place, it still grows only once for all of them. Dense points grow less.
PER_PIXEL, SHARP, POWER, SETTLED, DENSE_SHARE = 0.009, 0.0125, 3, 0.03, 0.4


@dataclass(frozen=True)
class Segment:
    """A number of consecutive steps that are alike; `regularises`: they compare with source
    views."""

    steps: int
    level: float
    gaussians: int
    regularises: bool


def simulate(schedule: Schedule, detail: Callable[[float], float] | None = None) -> list[Segment]:
    """Predict the segments of a whole run; the simulation changes the state of the schedule.

    `detail` is level -> `estimate.forecast.photo_detail` of it; None: photos are sharp.
    """
    return [Segment(len(list(steps)), *kind) for kind, steps in groupby(_steps(schedule, detail))]


def _steps(schedule: Schedule, detail: Callable[[float], float] | None) -> Iterator[tuple[float, int, bool]]:
    """(level, gaussians, whether it regularises) of each step."""
    flat = {f"{variant}_mean": 1.0 for variant in VARIANTS}
    count = schedule.facts.count
    pixels = schedule.facts.pixels / max(1.0, schedule.facts.shown_in / USUAL_PHOTOS)  # nan: 1
    for iteration in range(1, schedule.options.iterations + 1):
        plan = schedule.plan(iteration)
        entered = max(min(count, FEWEST_ENTERING), int(count / plan.level**2)) if schedule.facts.dense else count
        yield plan.level, entered, plan.regularises > 0
        if plan.grows:
            share = 1.0 if detail is None else min(1.0, (detail(plan.level) / SHARP) ** POWER)
            share *= DENSE_SHARE if schedule.facts.dense else 1.0
            densified = PER_PIXEL * share * pixels / plan.level**2 * SETTLED**plan.decay
            count = _grown(schedule, iteration, count, densified)
        if iteration % schedule.observe_every == 0:
            schedule.observe(iteration, flat)


def largest(segments: Sequence[Segment]) -> int:
    """The largest number of gaussians during a run."""
    return max(segment.gaussians for segment in segments)


def _grown(schedule: Schedule, iteration: int, count: int, densified: float) -> int:
    """Number of gaussians after a round of growth, as in `Schedule.grow`."""
    above = int(min(densified, MOST_DENSIFIED * count))
    target, limit = schedule.target(iteration, count, above), schedule.options.max_gaussians
    if limit:
        target = min(limit, limit if target is None else target)
    if target is None:
        return count + above
    room = target - count  # below 0 where the round only removes
    return count + (room if schedule.fills_target else min(above, room))
