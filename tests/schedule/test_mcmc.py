"""The schedule of 3DGS-MCMC: when it grows, and to how many gaussians."""

import pytest

from clsplat.options import TrainOptions, resolve
from clsplat.schedule import registry
from clsplat.schedule.mcmc import Mcmc
from clsplat.schedule.plan import SceneFacts
from clsplat.schedule.steps import scaled_steps

START = 1000
FACTS = SceneFacts((640, 480), START, 1.0, photos=None, pixels=10**8)


def schedule_of(facts=FACTS, **given):
    return Mcmc(scaled_steps(resolve({"schedule": "mcmc", "iterations": 30000}, given)), facts)


def test_it_is_known_by_name_and_relocates():
    assert registry.schedule_of("mcmc") is Mcmc and Mcmc.fills_target
    assert not TrainOptions().position_noise and Mcmc.levels == (1.0,)


@pytest.mark.parametrize("iterations, last", [(30000, 24900), (7000, 5800)])
def test_rounds_in_the_first_five_sixths(iterations, last):
    schedule = schedule_of(iterations=iterations)
    plans = {i: schedule.plan(i) for i in range(1, iterations + 1)}
    assert [i for i, plan in plans.items() if plan.grows] == list(range(601, last + 2, 100))
    for plan in plans.values():
        assert not (plan.gathers or plan.resets_opacity or plan.prunes_large or plan.regularises)


def test_a_twentieth_more_up_to_the_cap():
    schedule = schedule_of(max_gaussians=1100)
    assert schedule.target(601, START, 0) == 1050 and schedule.target(701, 1050, 9) == 1100
    assert schedule.target(801, 1100, 0) == 1100
    assert schedule.target(801, 5000, 0) == 5000  # the initial ones may be more
    assert schedule_of(mcmc_growth=0.5).target(601, START, 0) == 1500
