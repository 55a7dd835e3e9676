"""The constant schedule: when it grows, resets and raises the degree, and scaled step counts."""

import dataclasses

import pytest

from clsplat.options import resolve
from clsplat.schedule.constant import Constant
from clsplat.schedule.plan import SceneFacts
from clsplat.schedule.steps import scaled_steps

FACTS = SceneFacts((640, 480), 1000, 1.0, photos=None, pixels=10**8)


def options_of(**given):
    """What `--schedule constant` makes of the given options, with scaled steps."""
    return scaled_steps(resolve({"schedule": "constant", "iterations": 30000}, given))


def steps(options, asked):
    """The steps whose plan says so."""
    schedule = Constant(options, FACTS)
    return [i for i in range(1, options.iterations + 1) if getattr(schedule.plan(i), asked)]


DEFAULTS = options_of(iterations=7000)


def test_rounds_of_growth():
    """After the step behind each round number: within (500, 3500), every 100."""
    assert steps(DEFAULTS, "grows") == [i + 1 for i in range(600, 3500, 100)]


def test_statistics_are_gathered_as_long_as_they_are_read():
    assert steps(DEFAULTS, "gathers") == list(range(1, 3501))


def test_opacities_are_reset_while_growing_only():
    assert steps(DEFAULTS, "resets_opacity") == [3001]
    assert steps(options_of(reset_every=0), "resets_opacity") == []
    longer = options_of(iterations=30000)
    assert steps(longer, "resets_opacity") == [3001, 6001, 9001, 12001]


def test_large_ones_are_pruned_after_the_first_reset_only():
    assert steps(DEFAULTS, "prunes_large")[0] == 3002
    assert steps(options_of(reset_every=0), "prunes_large") == []


def test_degree_rises_to_the_highest():
    schedule = Constant(DEFAULTS, FACTS)
    assert [schedule.plan(i).degree for i in (1, 1000, 1001, 2001, 3000, 3001, 7000)] == [0, 0, 1, 2, 2, 3, 3]
    low = Constant(options_of(sh_degree=1), FACTS)
    assert low.plan(30000).degree == 1


def test_the_position_rate_decays_evenly_over_the_run():
    schedule = Constant(DEFAULTS, FACTS)
    assert [schedule.plan(i).decay for i in (1, 1751, 3501, 7000)] == [0, 0.25, 0.5, 6999 / 7000]
    schedule.options = dataclasses.replace(DEFAULTS, iterations=3500)  # a time budget moves the end
    assert [schedule.plan(i).decay for i in (1, 1751, 3500, 3501, 9000)] == [0, 0.5, 3499 / 3500, 1, 1]


def test_scaled_steps():
    scaled = options_of(iterations=7000, steps_scale=0.1, reset_every=0)
    assert (
        scaled.iterations,
        scaled.densify_from,
        scaled.densify_until,
        scaled.densify_every,
        scaled.sh_every,
        scaled.reset_every,
    ) == (700, 50, 350, 10, 100, 0)
    assert scaled_steps(scaled) == scaled
    assert steps(scaled, "grows") == [i + 1 for i in range(60, 350, 10)]


@pytest.mark.parametrize(
    "schedule, until, every",
    [("constant", 3500, 100), ("taming", 3500, 116), ("dash", 6300, 100), ("mcmc", 5833, 100), ("sig", 7000, 0)],
)
@pytest.mark.parametrize("scale", [1.0, 0.1])
def test_what_is_not_told_is_the_schedule_s_own(schedule, until, every, scale):
    """Rounds of sig follow the length of its levels: 0 leaves them to it, at any scale."""
    scaled = scaled_steps(resolve({}, {"schedule": schedule, "iterations": 7000, "steps_scale": scale}))
    assert scaled.densify_until == round(until * scale)
    assert scaled.densify_every == round(every * scale)
    told = scaled_steps(
        resolve(
            {},
            {"schedule": schedule, "iterations": 7000, "densify_until": 900, "densify_every": 30, "steps_scale": scale},
        )
    )
    assert (told.densify_until, told.densify_every) == (900 * scale, 30 * scale)
