"""The schedule of Taming 3DGS: how many gaussians each round of growth may reach."""

import dataclasses

import numpy as np
import pytest

from clsplat.options import TrainOptions
from clsplat.schedule import registry
from clsplat.schedule.constant import Constant
from clsplat.schedule.plan import SceneFacts
from clsplat.schedule.steps import scaled_steps
from clsplat.schedule.taming import Taming

START, BUDGET = 1000, 5.0
OPTIONS = scaled_steps(TrainOptions(iterations=30000, schedule="taming", taming_budget=BUDGET, densify_every=500))


def schedule_of(**changes):
    return Taming(
        dataclasses.replace(OPTIONS, **changes), SceneFacts((640, 480), START, 1.0, photos=None, pixels=10**8)
    )


def targets(schedule, count=0):
    o = schedule.options
    return [schedule.target(i, count, 0) for i in range(1, o.iterations + 1) if schedule.plan(i).grows]


def test_it_is_known_by_name_and_grows_by_score():
    assert registry.schedule_of("taming") is Taming and Taming.fills_target


def test_from_the_start_to_the_budget():
    schedule = schedule_of()
    assert schedule.target(501, 0, 0) == START
    assert schedule.target(15001, 0, 0) == START * BUDGET
    assert schedule.target(1, 0, 0) == START and schedule.target(30000, 0, 0) == START * BUDGET
    middle = (500 + 15000) // 2
    assert schedule.target(middle + 1, 0, 0) == START * (1 + 0.75 * (BUDGET - 1))


def test_growth_slows_down_to_nothing():
    rises = np.diff([START, *targets(schedule_of())])
    assert len(rises) == 28 and (rises > 0).all() and (np.diff(rises) <= 0).all()
    # the last interval of 29 is left out: a parabola's last 29th
    assert targets(schedule_of())[-1] == int(START + START * (BUDGET - 1) * (1 - 1 / 29**2))


def test_it_never_asks_for_fewer():
    assert schedule_of().target(1001, 10**6, 0) == 10**6


@pytest.mark.parametrize("limit, last", [(3000, 3000), (10**6, 5000), (500, 500)])
def test_the_budget_keeps_to_the_limit(limit, last):
    assert schedule_of(max_gaussians=limit).target(15001, 0, 0) == last


def test_a_moved_end_moves_the_curve():
    schedule = schedule_of()
    before = schedule.target(7001, 0, 0)
    schedule.options = dataclasses.replace(OPTIONS, iterations=20000, densify_until=10000)
    assert schedule.target(7001, 0, 0) > before
    assert schedule.target(10001, 0, 0) == START * BUDGET
    schedule.options = dataclasses.replace(OPTIONS, densify_from=500, densify_until=500)
    assert schedule.target(501, 0, 0) == START  # no room for growth, no division by nothing


def test_everything_else_is_as_in_3dgs():
    facts = SceneFacts((640, 480), START, 1.0, photos=None, pixels=10**8)
    constant = Constant(OPTIONS, facts)
    for iteration in (1, 501, 1001, 1002, 3001, 15001, 30000):
        assert schedule_of().plan(iteration) == constant.plan(iteration)
    assert schedule_of().levels == (1.0,)
