"""The SIG schedule: when levels change and growth happens, under made-up frequencies."""

import dataclasses
import json

import numpy as np
import pytest

from clsplat.schedule.sig import GROWS_SHARE, LEAST_SHOWN, LEVELS, ROUND_STEPS, Sig
from tests.densify.test_round import a_round
from tests.schedule.driven_sig import (
    FACTS,
    PRESETS,
    decisions,
    drive,
    flat,
    lengths,
    options_of,
    rising,
    rounds,
    sig,
    wild,
)

RECORD = {"level", "reason", "since", "rounds", "frequency", "slope", "threshold", "hits"}


def test_one_level_is_all_there_is():
    schedule = sig(levels=(1.0,))
    taken = drive(schedule)
    assert not decisions(taken) and {plan.level for _, plan, _ in taken} == {1.0}
    assert len(rounds(taken, 1.0)) == schedule.options.rounds
    assert schedule.last and schedule.latest is None


def test_each_level_ends_once_it_has_grown_and_converged():
    schedule = sig(rounds=5, iterations=20_000)
    taken = drive(schedule)
    found = decisions(taken)
    assert [d["level"] for _, d in found] == [2.0, 1.0]
    for (end, decision), level in zip(found, schedule.levels):
        assert set(decision) == RECORD and decision["reason"] == "converged"
        assert decision["rounds"] == len(rounds(taken, level)) == schedule.options.rounds
        assert decision["hits"] == schedule.options.convergence_hits
        assert decision["frequency"] == 30.0 and decision["slope"] == 0 < decision["threshold"]
        assert decision["since"] == lengths(taken)[level]
        assert end > rounds(taken, level)[-1]
    assert taken[found[0][0]][1].level == 2.0, "the very next step"


@pytest.mark.parametrize("iterations", [40, 300, 6000])
@pytest.mark.parametrize("levels", [(4.0, 2.0, 1.0), LEVELS, (2.0, 1.0)])
@pytest.mark.parametrize("frequency", [rising, wild, flat])
def test_the_finest_level_always_gets_its_share(iterations, levels, frequency):
    schedule = sig(iterations=iterations, levels=levels)
    taken = drive(schedule, frequency)
    share = schedule.options.level_share * iterations
    steps = lengths(taken)
    assert list(steps) == list(levels)
    for level in levels[:-1]:
        own = share / level / sum(1 / each for each in levels[:-1])
        assert steps[level] <= max(own, schedule.observe_every)
    assert steps[1.0] >= iterations - max(share, len(levels) * schedule.observe_every)
    if frequency is rising:
        assert {d["reason"] for _, d in decisions(taken)} == {"deadline"}
        for _, decision in decisions(taken):
            assert decision["hits"] == 0
            assert decision["slope"] is None or decision["slope"] >= decision["threshold"]


def test_a_miss_between_hits_counts_them_anew():
    """The paper's test looks at one difference, so a single jump is a single miss."""
    kind = {"preset": "paper", "convergence_hits": 3}
    (first,) = {decisions(drive(sig(**kind)))[0][0]}
    step = sig(**kind).observe_every

    def jumps(iteration):
        return 30.0 + 9.0 * (iteration >= first)

    assert decisions(drive(sig(**kind), jumps))[0][0] == first + 3 * step


def test_nothing_is_tested_before_growth_is_over():
    """Guard: however flat the frequency is, no hit counts until the last round has settled."""
    schedule = sig(convergence_hits=1, level_share=0.8)
    seen = {}
    observe = schedule.observe

    def note(iteration, frequency):
        decision = observe(iteration, frequency)
        seen[iteration] = decision or schedule.latest
        return decision

    schedule.observe = note
    taken = drive(schedule)
    end = decisions(taken)[0][0]
    last = rounds(taken, 4.0)[-1]
    assert len([i for i in seen if i < last]) > 5
    for iteration, found in seen.items():
        if iteration < last + 2 * schedule.observe_every:
            assert found["hits"] == 0, iteration
    assert last + 2 * schedule.observe_every <= end < last + 3 * schedule.observe_every


@pytest.mark.parametrize("preset", ["paper", "release"])
def test_published_tests_are_not_guarded(preset):
    schedule = sig(preset=preset, levels=(2.0, 1.0), iterations=20_000)
    first = decisions(drive(schedule))[0][1]
    assert first["reason"] == "converged" and first["rounds"] < schedule.options.rounds
    needed = {"paper": 1 + 1, "release": 6 + 4}[preset]
    assert first["since"] == needed * schedule.observe_every


@pytest.mark.one_in(3)
@pytest.mark.parametrize("iterations", [1000, 12000])
@pytest.mark.parametrize("count", [1, 5, 12])
@pytest.mark.parametrize("frequency", [flat, rising])
def test_growth_comes_in_rounds(iterations, count, frequency):
    schedule = sig(iterations=iterations, rounds=count)
    taken = drive(schedule, frequency)
    for level, steps in lengths(taken).items():
        of_level = rounds(taken, level)
        first = next(i for i, plan, _ in taken if plan.level == level)
        assert len(of_level) <= count
        spacings = set(np.diff(of_level))
        assert len(spacings) <= 1 and max(spacings, default=1) <= ROUND_STEPS[1]
        shares = dict(zip(schedule.levels, schedule.shares))
        allotment = shares[level] * iterations if level in shares else steps
        assert all(first < i <= first + GROWS_SHARE * allotment for i in of_level)
        last = [i for i, plan, _ in taken if plan.level == level and plan.gathers][-1]
        if len(of_level) == count:
            assert last == of_level[-1], "nothing is gathered that no round reads"
        else:
            assert abs(last - first - min(steps, GROWS_SHARE * allotment)) <= 1


def test_a_model_grows_no_larger_than_its_pixels_can_tell_apart():
    """At each level its own, and by a fifth a round at most; never less than what is there."""
    schedule = sig(pixels_per_gaussian=50.0)
    ceiling = 10 * 640 * 480 // 16 // 50
    assert schedule.target(1, 1000, 10**6) == 1200
    assert schedule.target(2, ceiling - 3, 10**6) == ceiling
    assert schedule.target(3, 2 * ceiling, 10**6) == 2 * ceiling
    drive(schedule, until=decisions(drive(sig(pixels_per_gaussian=50.0)))[0][0])
    assert schedule.target(1, 4 * ceiling - 3, 10**6) == 4 * ceiling
    assert sig(pixels_per_gaussian=0.0).target(1, 10**6, 10**6) is None


def test_a_full_level_gathers_nothing_and_waits_for_no_round():
    full = drive(sig(pixels_per_gaussian=200.0))  # 960 at the first level, where 1000 begin
    roomy = drive(sig(pixels_per_gaussian=0.0))
    assert {plan.level for _, plan, _ in full if plan.gathers} == {2.0, 1.0}
    assert decisions(full)[0][1]["reason"] == "converged"
    assert full[decisions(full)[0][0]][1].gathers, "the next has room from its first step"
    assert decisions(full)[0][0] < rounds(roomy, 4.0)[-1] < decisions(roomy)[0][0]


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.one_in(3)
def test_rounds_left_over_are_carried_by_the_release_only(preset):
    """Its extra rounds pile up, are never used up, and do not count as left over again."""
    count = 20
    schedule = sig(preset=preset, levels=(4.0, 2.0, 1.0), iterations=60_000, rounds=count, densify_every=50)
    taken = drive(schedule, flat)
    grown = [len(rounds(taken, level)) for level in schedule.levels]
    if preset == "release":
        left = [count - grown[0], max(0, count - grown[1])]
        assert grown[0] < count and left[0] > 0
        assert grown[2] == count + sum(left) and schedule.carried == sum(left)
    else:
        assert grown[2] == count and schedule.carried == 0


def test_opacities_are_reset_while_growing_only():
    schedule = sig(reset_every=300)
    for iteration, plan, _ in drive(schedule):
        assert plan.resets_opacity == (plan.gathers and iteration > 1 and (iteration - 1) % 300 == 0)
    assert not any(plan.resets_opacity for _, plan, _ in drive(sig()))


def test_photos_are_compared_while_growing_with_less_weight_later():
    schedule = sig(reproject="on", reproject_weight=0.2)
    taken = drive(schedule)
    for iteration, plan, _ in taken:
        assert (plan.regularises > 0) == plan.gathers
        if plan.regularises:
            assert plan.regularises == pytest.approx(0.2 * 10 ** -((iteration - 1) / 6000))
    assert not any(plan.regularises for _, plan, _ in drive(sig(reproject="off")))


def test_the_position_rate_decays_at_the_finest_level_only():
    taken = drive(sig())
    first = next(i for i, plan, _ in taken if plan.level == 1.0)
    for iteration, plan, _ in taken:
        expected = max(0, (iteration - first) / (6001 - first))
        assert plan.decay == pytest.approx(expected)


@pytest.mark.parametrize("preset", ["paper", "release"])
def test_as_published_it_decays_over_the_whole_run(preset):
    for iteration, plan, _ in drive(sig(preset=preset)):
        assert plan.decay == pytest.approx((iteration - 1) / 6000)


@pytest.mark.parametrize("frequency", [flat, rising])
def test_what_is_ahead(frequency):
    """All steps that are left, at levels from the present one on."""
    schedule = sig(iterations=5900)  # deadlines lie between looks
    for step in range(1, 5901):
        drive(schedule, frequency, first=step, until=step)
        ahead = schedule.ahead(step)
        assert [level for level, _ in ahead] == list(schedule.levels[schedule.index :])
        assert sum(steps for _, steps in ahead) == pytest.approx(5900 - step)
        if schedule.index == 0:
            assert ahead[0][1] == pytest.approx(max(0, 5900 / 6 - step))
            assert ahead[1][1] == pytest.approx(5900 / 3)
    assert dict(sig().ahead(0)) == pytest.approx({4.0: 1000, 2.0: 2000, 1.0: 3000})


@pytest.mark.slow
@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("frequency", [flat, wild])
@pytest.mark.one_in(3)
def test_stopped_anywhere_it_goes_on_alike(preset, frequency):
    """Through JSON, at every iteration."""
    for changes in ({"rounds": 6}, {"rounds": 6, "pixels_per_gaussian": 200.0}):
        changes = {
            **changes,
            "preset": preset,
            "levels": (4.0, 2.0, 1.0),
            "iterations": 1500,
            "level_share": 0.6,
            "densify_every": 40,
        }
        whole = drive(sig(**changes), frequency)
        assert decisions(whole)
        stopped = sig(**changes)
        for iteration in range(1, 1501):
            state = json.loads(json.dumps(stopped.state()))
            stopped = sig(**changes)
            stopped.load(state)
            (step,) = drive(stopped, frequency, iteration, iteration)
            # nan is no equal of itself
            assert repr(step) == repr(whole[iteration - 1])


def test_from_dense_points_what_few_pixels_show_goes_once_growth_ends():
    dense = dataclasses.replace(FACTS, dense=True)
    schedule, other = (Sig(options_of(pixels_per_gaussian=20.0), dense) for _ in range(2))
    taken = drive(schedule)
    *_, last = rounds(taken, 1.0)
    assert schedule.has_pruned and not any(plan.gathers for _, plan, _ in taken[last:])
    drive(other, until=last - 1)
    assert other.plan(last).grows and other.prunes_unneeded and not other.has_pruned
    few = np.array([0.9, 1.1, 0.5, np.inf]) * LEAST_SHOWN * 20
    made = a_round(frozen=(2,), count=4)
    made.weights = lambda: few
    growth = other.grow(made)
    assert growth.source.tolist() == [1, 2, 3] and growth.cloned == growth.split == 0
    assert other.has_pruned and not other.plan(last + 1).grows
    # a run of an earlier version, whose state lacks it, goes on without
    state = {name: value for name, value in other.state().items() if name != "has_pruned"}
    later = Sig(other.options, dense)
    later.load(state)
    assert not later.plan(last).grows
    assert not Sig(options_of(), FACTS).least_shown
