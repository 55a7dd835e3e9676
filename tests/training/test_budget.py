"""A time budget: whole runs under a made-up clock end when they should."""

import json
import re
from functools import partial
from types import SimpleNamespace

import pytest

from clsplat.config.option import MOST_STEPS
from clsplat.errors import InputError
from clsplat.options import resolve
from clsplat.schedule import SceneFacts, scaled_steps, schedule_of
from clsplat.schedule.plan import Plan
from clsplat.training.budget import (
    GROWTH_RECOVERY,
    MOST_OVERHEAD,
    REPORT_SECONDS,
    RESERVE_SHARE,
    RESET_RECOVERY,
    Deadline,
    TimeBudget,
)
from clsplat.training.session import Session

COUNT = 100_000  # gaussians at the start
FREQUENCIES = {f"{variant}_mean": 30.0 for variant in ("paper", "release", "robust")}


class Clock:
    """What the loop tells the time by, and what each of its acts takes.

    step: seconds of a step, called with (level, gaussians, iteration); evaluation, change (of the
    level), build (of kernels, at the first step): seconds; disk: bytes a second.
    """

    def __init__(self, step, evaluation=2.0, disk=150e6, change=0.5, build=15.0):
        self.build = build
        self.step, self.evaluation, self.disk, self.change = step, evaluation, disk, change
        self.now = 3.0  # of loading


class Simulated(Deadline):
    """A Deadline of a session without a device, whose steps take what a Clock says."""

    def __init__(self, seconds, clock, **options):
        options = scaled_steps(resolve({}, {
            "time_budget": f"{seconds}s", "iterations": 30000, **options}))
        schedule = schedule_of(options.schedule)(options, SceneFacts(
            size=(1600, 1200), count=COUNT, inverse_distance=20.0, photos=None,
            pixels=100 * 1600 * 1200))
        self.session = Unbuilt(options, schedule)
        self.made, self.clock = clock, SimpleNamespace(
            elapsed=lambda: clock.now, trained=lambda: clock.now - self.apart)
        self.apart = 0.0  # seconds so far that are not of training
        self.steps_at, self.kept_at = {}, []
        self.upheavals = {"lowered": 0, "level": 0, "grown": 0}  # the last step of each
        self.budget = TimeBudget(seconds, clock.evaluation, clock.now,
                                 self._checkpoint_bytes())

    def take_step(self):
        session, clock = self.session, self.made
        iteration = session.iteration + 1
        plan = self.allowed(session.schedule.plan(iteration))
        for name, happens in (("level", plan.level != session.level), ("grown", plan.grows),
                              ("lowered", plan.resets_opacity)):
            if happens:
                self.upheavals[name] = iteration
        if plan.level != session.level:
            clock.now += clock.change
            session.level, session.photos.read_seconds = plan.level, clock.change
            self.note_change()
        if iteration == 1:
            clock.now += clock.build
            self.apart += clock.build
        clock.now += clock.step(plan.level, session.step.count, iteration)
        if plan.grows:
            session.schedule.target(iteration, session.step.count, 0)
            session.step.count = min(4 * COUNT, session.step.count * 21 // 20)
        session.iteration = iteration
        self.steps_at[plan.level] = self.steps_at.get(plan.level, 0) + 1
        if iteration % session.schedule.observe_every == 0:
            session.schedule.observe(iteration, FREQUENCIES)
        self.estimate()

    def keep(self):
        self.kept_at.append(self.session.iteration)

    def run(self, checkpoint_every=0, until=None):
        """Seconds until the model is written, or until a step."""
        self.begin()
        session = self.session
        while session.iteration < min(until or session.options.iterations,
                                      session.options.iterations):
            self.take_step()
            if checkpoint_every and session.iteration % checkpoint_every == 0:
                self.save()
        if until:
            return self.made.now
        self.made.now += self.made.evaluation + REPORT_SECONDS
        self.save()
        return self.made.now

    def save(self):
        seconds = self._checkpoint_bytes() / self.made.disk
        self.made.now += seconds
        self.apart += seconds
        self.note_saved(seconds)


class Unbuilt(Session):
    """What a Deadline reads and moves of a Session."""

    def __init__(self, options, schedule):
        self.options, self.schedule, self.iteration = options, schedule, 0
        self.step = SimpleNamespace(options=options, count=COUNT)
        self.level = schedule.levels[0]
        self.decisions = SimpleNamespace(most_steps=MOST_STEPS, options=options)
        self.device = SimpleNamespace(finish=lambda: None)
        self.photos = SimpleNamespace(read_seconds=0.0)


def by_pixels(level, count, iteration, unit=0.03):
    """A GPU's: a fixed part, one by pixels, one by gaussians."""
    return unit * (0.1 + 0.5 / level**2 + 0.1 * count / COUNT)


def by_level(level, count, iteration, unit=0.02):
    return unit / level


def slowing(level, count, iteration):
    """A machine that gets hot, or a neighbour who starts something."""
    return by_pixels(level, count, iteration) * (1.5 if iteration > 5000 else 1)


@pytest.mark.one_in(3)
@pytest.mark.parametrize("step", [by_pixels, by_level, slowing])
@pytest.mark.parametrize("options", [{}, {"levels": (2.0, 1.0)},
                                     {"schedule": "constant"}], ids=str)
def test_a_run_ends_when_it_should(step, options):
    training = Simulated(240, Clock(step), **options)
    assert 0.97 * 240 < training.run() < 1.01 * 240
    assert set(training.steps_at) == set(training.session.schedule.levels)


@pytest.mark.parametrize("seconds, unit", [(60, 0.001), (60, 0.01), (3600, 0.5), (20, 0.05)])
def test_whatever_a_step_takes(seconds, unit):
    clock = Clock(partial(by_pixels, unit=unit), evaluation=0.02 * seconds, disk=100e6,
                  change=0.0, build=0.1 * seconds)
    assert 0.97 * seconds < Simulated(seconds, clock).run() < 1.03 * seconds


def test_checkpoints_on_the_way_are_paid_for():
    clock = Clock(by_level, disk=100e6)
    assert 0.97 * 240 < Simulated(240, clock).run(checkpoint_every=500) < 1.03 * 240


def test_the_schedule_is_laid_over_the_whole_run():
    training = Simulated(240, Clock(by_pixels), schedule="constant", densify_every=50)
    training.run()
    session = training.session
    assert session.options.iterations == session.iteration
    assert session.schedule.options is session.step.options is session.options
    assert session.options.densify_until == pytest.approx(session.iteration / 2, rel=0.02)
    assert session.schedule.plan(session.iteration).decay == pytest.approx(1, abs=0.01)


def test_the_finest_level_gets_its_share_of_the_steps():
    training = Simulated(240, Clock(by_pixels))
    training.run()
    share = training.steps_at[1.0] / training.session.iteration
    assert share > 0.9 * (1 - sum(training.session.schedule.shares))


def test_a_resumed_run_keeps_to_the_budget():
    """What it does not take over is only what the next steps tell anew."""
    first = Simulated(240, Clock(by_pixels))
    first.run(until=3000)
    first.save()
    before = first.session
    state = json.loads(json.dumps({"budget": first.state(),
                                   "schedule": before.schedule.state()}))
    again = Simulated(240, first.made)
    after = again.session
    again.load(state["budget"])
    after.schedule.load(state["schedule"])
    after.step.count, after.iteration = before.step.count, before.iteration
    assert again.budget.step_seconds == first.budget.step_seconds
    assert again.budget.rate == first.budget.rate
    assert after.options.iterations == before.options.iterations
    after.level = before.level
    assert 0.97 * 240 < again.run() < 1.01 * 240


# --- no end just after an upheaval


def by_area(level, count, iteration, unit=0.05):
    """A CPU's: by pixels, which the estimate of a level not seen yet takes for less."""
    return unit / level**2


@pytest.mark.parametrize("step", [by_pixels, by_level, by_area])
@pytest.mark.parametrize("seconds", [25, 31, 37, 60, 90])
@pytest.mark.parametrize("options", [
    {}, {"levels": (5.0, 4.0, 3.0, 2.0, 1.0), "level_share": 0.9},
    {"schedule": "constant", "reset_every": 300, "densify_until": 30000},
    {"schedule": "taming", "reset_every": 170, "densify_until": 30000}], ids=str)
@pytest.mark.one_in(5)
def test_a_run_never_ends_just_after_an_upheaval(step, seconds, options):
    """Reading a level's photos takes a tenth of the time, and steps get slower by up to 25 times
    from level to level."""
    clock = Clock(step, evaluation=0.5, change=seconds / 10, build=1.0)
    training = Simulated(seconds, clock, **options)
    training.budget.change_seconds = clock.change  # the first level's photos were read, too
    assert training.run() < 1.1 * seconds
    since = {name: training.session.iteration - at for name, at in training.upheavals.items() if at}
    assert since.get("lowered", RESET_RECOVERY) >= 0.8 * RESET_RECOVERY
    assert 0.8 * GROWTH_RECOVERY <= min(
        since.get(name, GROWTH_RECOVERY) for name in ("level", "grown"))


def plan_of(**changes):
    return Plan(**{"level": 1.0, "degree": 3, "gathers": True, "grows": True, "decay": 0.0,
                   "resets_opacity": True, "prunes_large": False, **changes})


@pytest.mark.parametrize("left, grows, lowers, stays", [
    (RESET_RECOVERY, True, True, False), (RESET_RECOVERY - 1, True, False, False),
    (GROWTH_RECOVERY, True, False, False), (GROWTH_RECOVERY - 1, False, False, True)])
def test_what_needs_time_begins_only_while_there_is_time(left, grows, lowers, stays):
    made = budget()
    plan = made.allowed(plan_of(), 2.0, left)
    assert (plan.grows, plan.resets_opacity, plan.level) == (grows, lowers, 2.0 if stays else 1.0)
    again = made.allowed(plan_of(), 2.0, 10**6)  # a level that was left out stays so
    assert (again.level == 2.0) is stays and again.grows is not stays
    restored = budget()
    restored.load(json.loads(json.dumps(made.state())))
    assert (restored.last_level == 2.0) is stays


def test_the_first_estimates_of_a_level_are_careful():
    made = budget()
    made.step_seconds = {2.0: 0.01}
    assert made.left(2.0, False, 0.0, 0) == int(LEFT / 0.01)
    assert made.left(1.0, False, 0.0, 0) == int(LEFT / 0.04)
    made.note_change(7.0, 0, 0.0)
    made.note_change(3.0, 0, 0.0)
    assert made.left(1.0, True, 0.0, 0) == int((LEFT - 7) / 0.04)


def test_evaluations_of_a_budget_are_paid_for():
    made = TimeBudget(100.0, 1.0, 0.0, 0, evaluations=8)
    assert made.reserve(0) == pytest.approx(8 + REPORT_SECONDS + 100 * RESERVE_SHARE)
    due = [second for second in range(100) if made.evaluates(second)]
    assert due == [13, 25, 38, 50, 63, 75, 88]
    assert made.reserve(0) == pytest.approx(1 + REPORT_SECONDS + 100 * RESERVE_SHARE)
    slow = TimeBudget(100.0, 4.0, 0.0, 0, evaluations=8)  # a tenth of the time: two
    assert [second for second in range(100) if slow.evaluates(second)] == [50]
    late = TimeBudget(100.0, 1.0, 0.0, 0, evaluations=8)
    assert late.evaluates(60) and not late.evaluates(61) and late.evaluates(63)


# --- the arithmetic

LEFT = 100 - 2 - REPORT_SECONDS - 100 * RESERVE_SHARE  # seconds for steps


def budget(seconds=100.0, evaluation=2.0, saved=0.0):
    return TimeBudget(seconds, evaluation, 0.0, saved)


def test_steps_by_hand():
    """100 s less those of evaluating and of the page and the spare ones, in steps of 0.1 s."""
    made = budget()
    made.note_steps(10, 1.0, 1.0)
    made.note_steps(20, 1.0, 2.0)
    assert made.step_seconds == {1.0: pytest.approx(0.1)}
    assert made.steps(20, [(1.0, 500)], 2.0, 0) == pytest.approx(20 + 10 * (LEFT - 2), abs=1)
    # 100 steps at a quarter of the time and 300 whole ones take 32.5 s
    made.step_seconds[4.0] = 0.025
    assert made.steps(20, [(4.0, 100), (1.0, 300)], 2.0, 0) == pytest.approx(
        20 + 400 * (LEFT - 2) / 32.5, abs=1)


def test_a_level_not_seen_yet_is_judged_by_the_nearest():
    made = budget()
    made.step_seconds = {5.0: 0.01, 2.0: 0.03}
    assert made.steps(0, [(1.0, 10)], 0.0, 0) == int(LEFT / 0.06)
    assert made.steps(0, [(4.0, 10)], 0.0, 0) == int(LEFT / (0.01 * 5 / 4))


def test_the_newest_measurement_counts_half():
    made = budget()
    for iteration, elapsed in ((0, 0.0), (10, 1.0), (20, 4.0)):
        made.note_steps(iteration, 1.0, elapsed)
    assert made.step_seconds[1.0] == pytest.approx(0.5 * 0.1 + 0.5 * 0.3)


def test_what_is_no_step_does_not_count():
    made = budget()
    made.begin_steps(10, 50.0)
    made.note_steps(10, 1.0, 50.1)
    assert made.step_seconds == {}
    made.begin_steps(10, 60.0)
    made.note_steps(20, 1.0, 62.0)
    assert made.step_seconds == {1.0: pytest.approx(0.2)}


def test_time_spent_ends_the_run_at_once():
    made = budget()
    made.step_seconds = {1.0: 0.1}
    for elapsed in (97.5, 99.0, 1000.0):
        assert made.steps(60, [(1.0, 40)], elapsed, 0) == 60
    assert made.steps(60, [], 0.0, 0) == made.steps(60, [(1.0, 0)], 0.0, 0) == 60


def test_writing_is_reserved_by_what_it_took():
    made = budget(saved=1e9)
    before = made.reserve(1e9)
    made.note_saved(5e8, 1.0)
    assert before - made.reserve(1e9) == pytest.approx(1e9 / 100e6 - 2)


@pytest.mark.parametrize("evaluation, saved", [(60.0, 0), (0.0, 6e9), (300.0, 3e10), (0.6, 0),
                                               (1e4, 1e9)])
def test_too_little_is_refused_and_the_cure_is_one(evaluation, saved):
    with pytest.raises(InputError) as caught:
        TimeBudget(1.0, evaluation, 0.3, saved)
    said = str(caught.value)
    needed = evaluation + saved / 100e6 + REPORT_SECONDS + 0.3 + RESERVE_SHARE
    assert said.startswith("--time-budget 1s: ") and "\n" not in said
    assert f"evaluating and saving once take {needed:.1f} s" in said
    least = float(re.search(r"give at least (\d+)s$", said)[1])
    made = TimeBudget(least, evaluation, 0.3, saved)
    assert made.reserve(saved) <= MOST_OVERHEAD * least
    with pytest.raises(InputError):
        TimeBudget(0.85 * least - 1, evaluation, 0.3, saved)


def test_time_that_is_left_is_not_used_for_more_steps_than_are_worth_taking():
    training = Simulated(240, Clock(by_level))
    training.session.decisions.most_steps = 500
    assert training.run() < 0.5 * 240 and training.session.iteration == 500
