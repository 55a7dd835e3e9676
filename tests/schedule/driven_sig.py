"""SIG schedules driven through whole runs by made-up frequencies, without a device."""

import math

import numpy as np

from clsplat.options import resolve
from clsplat.schedule.plan import SceneFacts
from clsplat.schedule.sig import Sig
from clsplat.schedule.steps import scaled_steps

FACTS = SceneFacts(size=(640, 480), count=1000, inverse_distance=20.0, photos=None, pixels=10 * 640 * 480)
# what the defaults may become must not matter
SHORT = {"iterations": 6000, "levels": (4.0, 2.0, 1.0), "level_share": 0.5, "rounds": 8, "densify_from": 500}
PRESETS = ("ours", "paper", "release")


def flat(iteration):
    return 30.0


def rising(iteration):
    """For ever, by more a step than any threshold here."""
    return float(np.exp(2e-3 * iteration))


def wild(iteration):
    """Neither: jumps, falls, some not a number."""
    rng = np.random.default_rng(iteration)
    return math.nan if rng.random() < 0.1 else float(30 + rng.normal(0, 0.2) + iteration / 3000)


def options_of(**changes):
    return scaled_steps(resolve({}, {**SHORT, **changes}))


def sig(**changes):
    return Sig(options_of(**changes), FACTS)


def drive(schedule, frequency=flat, first=1, until=None):
    """The (iteration, plan, decision) of each step, taken as the loop takes them."""
    taken = []
    for iteration in range(first, (until or schedule.options.iterations) + 1):
        plan = schedule.plan(iteration)
        if plan.grows:
            schedule.target(iteration, 1000, 10)
        decision = None
        if iteration % schedule.observe_every == 0:
            values = {f"{v}_{a}": math.nan for v in PRESETS for a in ("mean", "max", "min")}
            decision = schedule.observe(
                iteration, {**values, f"{schedule.options.frequency}_mean": frequency(iteration)}
            )
        taken.append((iteration, plan, decision))
    return taken


def decisions(taken):
    return [(iteration, decision) for iteration, _, decision in taken if decision]


def rounds(taken, level):
    return [iteration for iteration, plan, _ in taken if plan.grows and plan.level == level]


def lengths(taken):
    """Level -> its steps."""
    levels = [plan.level for _, plan, _ in taken]
    return {level: levels.count(level) for level in dict.fromkeys(levels)}
