"""The course of a run, foretold: a schedule driven to its end without a model.

What only training can tell is taken as it was in our runs: the frequency has converged as soon as
its schedule would believe it, and gaussians ask for more along a logistic curve, whose two numbers
were chosen on the runs named here. Where a ceiling or a budget ends growth, the end was foretold
within 1 % (sig on boruszyn, city, and caliterra with 30,000 steps; taming on boruszyn, lund).
Elsewhere it was 0.4 to 2.3 times the true one (sig with 7000 steps: lund 1.1, caliterra 1.4 at half
size, 2.2 at full; constant 0.8 to 2.3; dash 0.4 to 1.7): `--max-gaussians` makes it certain.
"""

from dataclasses import dataclass

DEMAND = 0.25  # of few gaussians, the share that asks for more in a round of growth
CROWDED = 40  # times the initial number: so many gaussians ask for no more
VARIANTS = ("robust", "paper", "release")


@dataclass(frozen=True)
class Stretch:
    """Equal steps in a row: their number, level, gaussians, and whether they compare adjacent
    photos."""

    steps: int
    level: float
    gaussians: int
    regularises: bool


def course(schedule):
    """[Stretch, ...] of a whole run; `schedule`, a new one, is used up."""
    options, start = schedule.options, schedule.subject.count
    flat = {f"{variant}_mean": 1.0 for variant in VARIANTS}
    count, taken = start, []
    for iteration in range(1, options.iterations + 1):
        plan = schedule.plan(iteration)
        kind = plan.level, count, plan.regularises > 0
        if taken and taken[-1][0] == kind:
            taken[-1][1] += 1
        else:
            taken.append([kind, 1])
        if plan.grows:
            count = _grown(schedule, iteration, count, start)
        if iteration % schedule.look == 0:
            schedule.observe(iteration, flat)
    return [Stretch(steps, *kind) for kind, steps in taken]


def largest(stretches):
    """The most gaussians at a time."""
    return max(stretch.gaussians for stretch in stretches)


def _grown(schedule, iteration, count, start):
    """Gaussians after a round of growth, as `train.step.Step` chooses them."""
    above = int(DEMAND * count * max(0.0, 1 - count / (CROWDED * start)))
    target, limit = schedule.target(iteration, count, above), schedule.options.max_gaussians
    if limit:
        target = min(limit, limit if target is None else target)
    if target is None:
        return count + above
    room = max(0, target - count)
    return count + (min(above, room) if schedule.selection == "threshold" else room)
