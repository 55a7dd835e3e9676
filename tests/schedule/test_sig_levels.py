"""The levels of the SIG schedule, their share of a run, and how many gaussians they allow."""

import dataclasses
import math

import pytest

from clsplat.errors import InputError
from clsplat.options import resolve
from clsplat.schedule.sig import (
    DENSE_LEVELS,
    LEVELS,
    SMALLEST_SIDE,
    STAYING,
    TILE,
    Sig,
    chosen_levels,
    level_shares,
    levels_of,
)
from clsplat.schedule.simulate import simulate
from clsplat.schedule.steps import worthwhile_steps
from tests.schedule.driven_sig import FACTS, drive, lengths, options_of, rising, sig


@pytest.mark.parametrize(
    "side, expected",
    [
        (SMALLEST_SIDE * LEVELS[0], LEVELS),
        (SMALLEST_SIDE * LEVELS[0] - 1, LEVELS[1:]),
        (SMALLEST_SIDE * 2, (2.0, 1.0)),
        (SMALLEST_SIDE * 2 - 1, (1.0,)),
        (1, (1.0,)),
    ],
)
def test_levels_too_small_to_matter_are_left_out(side, expected):
    assert chosen_levels(options_of(levels=()), (side, side + 100)) == expected
    assert chosen_levels(options_of(levels=()), (side + 100, side)) == expected


@pytest.mark.parametrize(
    "steps, expected",
    [
        (30_000, LEVELS),
        (3000, LEVELS),
        (2000, (4.0, 3.0, 2.0, 1.0)),
        (1200, (3.0, 2.0, 1.0)),
        (700, (2.0, 1.0)),
        (600, (2.0, 1.0)),
        (599, (1.0,)),
        (1, (1.0,)),
    ],
)
def test_levels_for_which_there_is_no_time_are_left_out(steps, expected):
    """The coarsest of 5, 4, 3, 2, 1 has 12 of 137 parts of the steps; that of 2, 1 has a third."""
    options = options_of(levels=(), level_share="auto", iterations=steps)
    assert chosen_levels(options, (640, 480)) == expected
    asked = options_of(iterations=1)
    assert chosen_levels(asked, (640, 480)) == asked.levels


@pytest.mark.parametrize(
    "steps, side, expected",
    [
        (30_000, 480, (4.0, 2.0, 1.0)),
        (30_000, 8 * SMALLEST_SIDE, DENSE_LEVELS),
        (350, 480, (4.0, 2.0, 1.0)),
        (349, 480, (2.0, 1.0)),
        (149, 480, (1.0,)),
    ],
)
def test_levels_with_which_dense_points_enter(steps, side, expected):
    """The coarsest of 4, 2, 1 has a seventh of the steps, that of 2, 1 a third."""
    options = options_of(levels=(), level_share="auto", iterations=steps)
    dense = dataclasses.replace(FACTS, dense=True, size=(side, side))
    assert levels_of(options, dense) == expected


def test_coarser_levels_do_not_grow_where_points_enter():
    dense = dataclasses.replace(FACTS, dense=True, count=1000)
    for facts in (FACTS, dense):
        schedule = Sig(options_of(levels=(2.0, 1.0), iterations=3000), facts)
        grown = {plan.level for plan in map(schedule.plan, range(1, 1000)) if plan.grows}
        assert grown == (set() if facts is dense else {2.0})
    segments = simulate(Sig(options_of(levels=(2.0, 1.0)), dense))
    assert segments[0].gaussians == 1000 / 2**2
    # for most of the finest level, those that photos show
    assert segments[-1].gaussians == int(STAYING * segments[-2].gaussians)
    assert segments[-1].steps > 2000


@pytest.mark.parametrize(
    "side, steps, expected",
    [(500, 3000, (2.0, 1.0)), (TILE * 2, 3000, (2.0, 1.0)), (TILE * 2 - 1, 3000, (1.0,)), (500, 599, (1.0,))],
)
def test_a_block_begins_at_half_the_size_and_prunes_as_it_goes(side, steps, expected):
    """The coarse run, at half size, has had the levels from 3 on."""
    options = options_of(levels=(), level_share="auto", iterations=steps)
    facts = dataclasses.replace(FACTS, disagreement=lambda: 0.036)
    assert Sig.options_of_block(options, (side, side + 9), facts) == {
        "levels": expected,
        "pixels_per_gaussian": pytest.approx(25.0),
    }
    asked = options_of(levels=(3.0, 1.0), pixels_per_gaussian=7.0)
    assert Sig.options_of_block(asked, (500, 500), facts) == {"pixels_per_gaussian": 7.0}


@pytest.mark.parametrize(
    "disagreement, pixels", [(0.072, 100.0), (0.036, 25.0), (0.01, 15.0), (0.0, 15.0), (math.nan, 17.4)]
)
def test_the_more_photos_disagree_the_more_pixels_a_gaussian_needs(disagreement, pixels):
    facts = dataclasses.replace(FACTS, disagreement=lambda: disagreement)
    limit, reason = Sig.planned_limit(options_of(), facts)
    assert limit == pytest.approx(FACTS.pixels / pixels, rel=3e-3)
    assert reason.startswith(f"{limit:,}: one for each {pixels} training pixels, as ")
    schedule = Sig(options_of(), facts)
    assert schedule.target(1, 10**6, 10**6) == 10**6 and schedule.target(2, 1, 10**6) <= limit // 16
    assert Sig.planned_limit(options_of(pixels_per_gaussian=50.0), facts)[0] == FACTS.pixels // 50
    assert Sig.planned_limit(options_of(pixels_per_gaussian=0.0), facts)[0] is None


@pytest.mark.parametrize(
    "disagreement, shown_in, steps",
    [
        (0.036, 5.0, 3500),
        (0.036, math.nan, 3500),
        (0.036, 1.25, 2000),
        (0.072, 20.0, 3500),
        (0.072, 5.0, 2000),
        (0.04, 5.0, 2551),
        (0.038, 4.0, 2129),
        (math.nan, 2.0, 3500),
    ],
)
def test_the_fewer_photos_show_a_place_the_fewer_steps_they_allow(disagreement, shown_in, steps):
    """The mean of n colours has an error of their deviation / sqrt(n); 40 photos, 50 steps each."""
    facts = dataclasses.replace(FACTS, disagreement=lambda: disagreement, shown_in=shown_in)
    assert Sig.most_steps(resolve({}, {}), facts, 40)[0] == steps
    assert Sig.most_steps(options_of(iterations=9), facts, 40)[0] == 0  # as many as requested
    assert Sig.most_steps(options_of(visits=3.0), facts, 40)[0] == 120


def test_given_levels_are_taken_as_they_are():
    levels = (7.5, 2.5, 1.0)
    assert chosen_levels(options_of(levels=levels), (int(7.5 * TILE), 500)) == levels
    assert sig(levels=levels).levels == levels
    assert chosen_levels(options_of(levels=(1.0,)), (3, 3)) == (1.0,)


def test_a_given_level_below_a_tile_is_refused():
    words = r"^--levels: level 8 .* 80 x 15 pixels, .* tile of 16; give "
    with pytest.raises(InputError, match=words):
        chosen_levels(options_of(levels=(8.0, 1.0)), (640, 8 * TILE - 1))


def test_each_level_may_take_what_its_resolution_is_of_all():
    assert level_shares((4.0, 2.0, 1.0), "auto") == pytest.approx((1 / 7, 2 / 7))
    assert level_shares((4.0, 2.0, 1.0), 0.6) == pytest.approx((0.2, 0.4))
    assert level_shares((4.0, 2.0, 1.0), 0.0) == pytest.approx((0, 0))
    assert level_shares((1.0,), "auto") == level_shares((1.0,), 0.5) == ()
    schedule = sig(level_share="auto")
    steps = lengths(drive(schedule, rising))
    for level, share in ((4.0, 1 / 7), (2.0, 2 / 7), (1.0, 4 / 7)):
        assert steps[level] == pytest.approx(share * 6000, abs=2 * schedule.observe_every)


def test_a_run_takes_no_more_steps_than_photos_allow():
    def steps(**given):
        return worthwhile_steps(resolve({}, given), FACTS, 60)[0]

    assert steps() == 4500 and steps(visits=10.0) == 600 and steps(visits=0.0) == 18_000
    assert steps(iterations=30_000) == 30_000 and steps(schedule="constant") == 18_000
    assert steps(iterations=30_000, visits=10.0) == 600
