"""The constant schedule: when it grows, resets and raises the degree, and scaled step counts."""

from clsplat.options import TrainOptions
from clsplat.schedule import SCHEDULES, scaled_steps
from clsplat.schedule.constant import Constant


def steps(options, asked):
    """The steps whose plan says so."""
    schedule = Constant(options)
    return [i for i in range(1, options.iterations + 1) if getattr(schedule.plan(i), asked)]


DEFAULTS = scaled_steps(TrainOptions(iterations=7000))


def test_it_is_known_by_name():
    assert SCHEDULES["constant"] is Constant


def test_rounds_of_growth():
    """After the step behind each round number: within (500, 3500), every 100."""
    assert steps(DEFAULTS, "grows") == [i + 1 for i in range(600, 3500, 100)]


def test_statistics_are_gathered_as_long_as_they_are_read():
    assert steps(DEFAULTS, "gathers") == list(range(1, 3501))


def test_opacities_are_reset_while_growing_only():
    assert steps(DEFAULTS, "resets_opacity") == [3001]
    assert steps(scaled_steps(TrainOptions(reset_every=0)), "resets_opacity") == []
    longer = scaled_steps(TrainOptions(iterations=30000))
    assert steps(longer, "resets_opacity") == [3001, 6001, 9001, 12001]


def test_large_ones_are_pruned_after_the_first_reset_only():
    assert steps(DEFAULTS, "prunes_large")[0] == 3002
    assert steps(scaled_steps(TrainOptions(reset_every=0)), "prunes_large") == []


def test_degree_rises_to_the_highest():
    schedule = Constant(DEFAULTS)
    assert [schedule.plan(i).degree for i in (1, 1000, 1001, 2001, 3000, 3001, 7000)] == [
        0, 0, 1, 2, 2, 3, 3]
    low = Constant(scaled_steps(TrainOptions(sh_degree=1)))
    assert low.plan(30000).degree == 1


def test_full_resolution_throughout():
    assert {Constant(DEFAULTS).plan(i).level for i in (1, 3000, 7000)} == {1.0}


def test_scaled_steps():
    scaled = scaled_steps(TrainOptions(iterations=7000, steps_scale=0.1, reset_every=0))
    assert (scaled.iterations, scaled.densify_from, scaled.densify_until, scaled.densify_every,
            scaled.sh_every, scaled.reset_every) == (700, 50, 350, 10, 100, 0)
    assert scaled_steps(scaled) == scaled
    assert steps(scaled, "grows") == [i + 1 for i in range(60, 350, 10)]


def test_a_count_is_never_scaled_to_nothing():
    scaled = scaled_steps(TrainOptions(iterations=40, steps_scale=1e-3))
    assert (scaled.iterations, scaled.densify_every, scaled.densify_until) == (1, 1, 1)


def test_growth_ends_where_it_is_told():
    told = scaled_steps(TrainOptions(iterations=7000, densify_until=1000))
    assert steps(told, "grows") == [601, 701, 801, 901]
