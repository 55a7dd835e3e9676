"""A time budget: whole runs under a made-up clock end when they should."""

import json
import re
from types import SimpleNamespace

import pytest

from clsplat.config.option import MOST_STEPS
from clsplat.errors import InputError
from clsplat.options import resolve
from clsplat.schedule.plan import Plan, SceneFacts
from clsplat.schedule.registry import schedule_of
from clsplat.schedule.steps import scaled_steps
from clsplat.training import budget
from clsplat.training.model import checkpoint_bytes
from clsplat.training.session import Session

COUNT = 100_000  # gaussians at the start
RATE = 100e6  # bytes of a checkpoint a second, as measured before the first
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


class Simulated(budget.Deadline):
    """A Deadline of a session without a device, whose steps take what a Clock says."""

    def __init__(self, seconds, clock, **options):
        options = scaled_steps(
            resolve({}, {"time_budget": f"{seconds}s", "iterations": 30000, "eval_every": 0, **options})
        )
        schedule = schedule_of(options.schedule)(
            options,
            SceneFacts(size=(1600, 1200), count=COUNT, inverse_distance=20.0, photos=None, pixels=100 * 1600 * 1200),
        )
        self.made, self.apart = clock, 0.0  # seconds so far that are not of training
        self.steps_at, self.upheavals = {}, {"lowered": 0, "level": 0, "grown": 0}  # the last steps
        super().__init__(
            Unbuilt(options, schedule),
            SimpleNamespace(elapsed=lambda: clock.now, trained=lambda: clock.now - self.apart),
            clock.evaluation,
            RATE,
        )

    def take_step(self):
        session, clock = self.session, self.made
        iteration = session.iteration + 1
        plan = self.allowed(session.schedule.plan(iteration))
        for name, happens in (
            ("level", plan.level != session.level),
            ("grown", plan.grows),
            ("lowered", plan.resets_opacity),
        ):
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

    def run(self, checkpoint_every=0, until=None):
        """Seconds until the model is written, or until a step."""
        self.begin()
        session = self.session
        while session.iteration < min(until or session.options.iterations, session.options.iterations):
            self.take_step()
            if checkpoint_every and session.iteration % checkpoint_every == 0:
                self.save()
        if until:
            return self.made.now
        self.made.now += self.made.evaluation + budget.REPORT_SECONDS
        self.save()
        return self.made.now

    def save(self):
        seconds = checkpoint_bytes(self.session.step.count, 3) / self.made.disk
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
@pytest.mark.parametrize("options", [{}, {"levels": (2.0, 1.0)}, {"schedule": "constant"}], ids=str)
def test_a_run_ends_when_it_should(step, options):
    training = Simulated(240, Clock(step), **options)
    assert 0.97 * 240 < training.run() < 1.01 * 240
    assert set(training.steps_at) == set(training.session.schedule.levels)


def test_the_schedule_is_laid_over_the_whole_run():
    training = Simulated(240, Clock(by_pixels), schedule="constant", densify_every=50)
    training.run()
    session = training.session
    assert session.options.iterations == session.iteration
    assert session.schedule.options is session.step.options is session.options
    assert session.options.densify_until == pytest.approx(session.iteration / 2, rel=0.02)
    assert session.schedule.plan(session.iteration).decay == pytest.approx(1, abs=0.01)


def test_a_resumed_run_keeps_to_the_budget():
    """What it does not take over is only what the next steps tell anew."""
    first = Simulated(240, Clock(by_pixels))
    first.run(until=3000)
    first.save()
    before = first.session
    state = json.loads(json.dumps({"budget": first.state(), "schedule": before.schedule.state()}))
    again = Simulated(240, first.made)
    after = again.session
    again.load(state["budget"])
    after.schedule.load(state["schedule"])
    after.step.count, after.iteration = before.step.count, before.iteration
    assert again.state() == first.state()
    assert after.options.iterations == before.options.iterations
    after.level = before.level
    assert 0.97 * 240 < again.run() < 1.01 * 240


def by_area(level, count, iteration, unit=0.05):
    """A CPU's: by pixels, which the estimate of a level not seen yet takes for less."""
    return unit / level**2


@pytest.mark.parametrize("step", [by_pixels, by_level, by_area])
@pytest.mark.parametrize("seconds", [25, 31, 37, 60, 90])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"levels": (5.0, 4.0, 3.0, 2.0, 1.0), "level_share": 0.9},
        {"schedule": "constant", "reset_every": 300, "densify_until": 30000},
        {"schedule": "taming", "reset_every": 170, "densify_until": 30000},
    ],
    ids=str,
)
@pytest.mark.one_in(13)
def test_a_run_never_ends_just_after_an_upheaval(step, seconds, options):
    """Reading a level's photos takes a tenth of the time, and steps get slower by up to 25 times
    from level to level."""
    clock = Clock(step, evaluation=0.5, change=seconds / 10, build=1.0)
    training = Simulated(seconds, clock, **options)
    training.session.photos.read_seconds = clock.change  # the first level's photos, too
    training.note_change()
    assert training.run() < 1.1 * seconds
    since = {name: training.session.iteration - at for name, at in training.upheavals.items() if at}
    assert since.get("lowered", budget.RESET_RECOVERY) >= 0.8 * budget.RESET_RECOVERY
    assert 0.8 * budget.GROWTH_RECOVERY <= min(since.get(name, budget.GROWTH_RECOVERY) for name in ("level", "grown"))


def after_steps(seconds, **options):
    """A Deadline of 100 s whose steps at level 1 take so many seconds."""
    training = Simulated(100, Clock(lambda *_: seconds, evaluation=0.0, build=0.0), levels=(2.0, 1.0), **options)
    training.session.level = 1.0
    training.begin()
    training.made.now += 10 * seconds
    training.session.iteration = 10
    training.estimate()
    return training


@pytest.mark.parametrize(
    "left, grows, lowers, stays",
    [
        (budget.RESET_RECOVERY, True, True, False),
        (budget.RESET_RECOVERY - 1, True, False, False),
        (budget.GROWTH_RECOVERY, True, False, False),
        (budget.GROWTH_RECOVERY - 1, False, False, True),
    ],
)
def test_what_needs_time_begins_only_while_there_is_time(left, grows, lowers, stays):
    made = after_steps(0.1)
    made.session.level = 2.0
    made.made.now += made._left() - (left + 0.5) * 0.1
    plan = Plan(level=1.0, degree=3, gathers=True, grows=True, decay=0.0, resets_opacity=True, prunes_large=False)
    found = made.allowed(plan)
    assert (found.grows, found.resets_opacity, found.level) == (grows, lowers, 2.0 if stays else 1.0)
    restored = after_steps(0.1)
    restored.session.level = 2.0
    restored.load(json.loads(json.dumps(made.state())))
    again = restored.allowed(plan)  # a level that was left out stays so
    assert (again.level == 2.0) is stays and again.grows is not stays


def test_evaluations_are_evenly_spaced_and_take_an_eighth_of_the_time():
    made = Simulated(100, Clock(by_level, evaluation=1.0), eval_every="auto")

    def due():
        found = []
        for made.made.now in range(100):
            found += [made.made.now] * made.evaluates()
        return found

    assert due() == [13, 25, 38, 50, 63, 75, 88]
    made = Simulated(100, Clock(by_level, evaluation=4.0), eval_every="auto")
    assert due() == [34, 67]


@pytest.mark.parametrize("evaluation", [0.6, 60.0, 1e4])
def test_too_little_is_refused_and_the_cure_is_one(evaluation):
    clock = Clock(by_level, evaluation=evaluation)
    needed = clock.now + evaluation + budget.REPORT_SECONDS + budget.RESERVE_SHARE + (checkpoint_bytes(COUNT, 3) / RATE)
    with pytest.raises(InputError, match=rf"^--time-budget 1s: .*saving once take {needed:.1f} s") as caught:
        Simulated(1, clock)
    least = int(re.search(r"give at least (\d+)s$", str(caught.value))[1])
    Simulated(least, clock)
    with pytest.raises(InputError):
        Simulated(int(0.85 * least) - 1, clock)


def test_time_that_is_left_is_not_used_for_more_steps_than_are_worth_taking():
    training = Simulated(240, Clock(by_level))
    training.session.decisions.most_steps = 500
    assert training.run() < 0.5 * 240 and training.session.iteration == 500


def test_files_of_gaussians_that_will_enter_have_their_time():
    """They are 64 times as large as those of a level of 8."""
    training = Simulated(240, Clock(by_level))
    whole, training.session.step.count = training._reserve(), COUNT // 64
    assert training._reserve() == whole
    training.note_saved(checkpoint_bytes(COUNT // 64, 3) / RATE)
    assert training._reserve() == pytest.approx(whole)
    training.session.step.count = 2 * COUNT
    assert training._reserve() > whole


@pytest.mark.parametrize("seconds, rate", [(0.0, 1e9), (1.0, 3.25e7)])
def test_how_fast_the_disk_of_a_run_is(tmp_path, monkeypatch, seconds, rate):
    """On an H200 77 of 140 s were kept for files that took 12: 100 MB/s had been assumed."""
    now = [0.0]
    monkeypatch.setattr(budget.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr("os.fsync", lambda _: now.__setitem__(0, seconds))
    assert budget.saved_a_second(tmp_path) == pytest.approx(rate, rel=0.01)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("views, together, expected", [(0, 4, 0), (3, 4, 2), (40, 4, 20), (40, 1, 80)])
def test_evaluations_take_as_long_as_views_that_are_scored_together(monkeypatch, views, together, expected):
    """Each call takes two seconds."""
    now, calls = [0.0], []
    monkeypatch.setattr(budget.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(budget, "scored_at_once", lambda _: together)
    monkeypatch.setattr(budget, "CurrentRenderer", lambda _: None)

    def evaluated(*arguments):
        calls.append(len(arguments[3]))
        now[0] += 2

    monkeypatch.setattr(budget, "evaluate_views", evaluated)
    session = SimpleNamespace(
        test_views=views * [None], renderer=None, model=None, options=SimpleNamespace(sh_degree=3)
    )
    assert budget.evaluation_seconds(session) == expected
    assert calls == ([1, min(views, together)] if views else [])
