"""The three tests of convergence, on curves whose answer is known."""

import numpy as np
import pytest

from clsplat.schedule.convergence import MEDIAN_OF, SLOPE_SHARE, WINDOW, judge

SPACING = 100
TESTS = ("robust", "paper", "release")
RATE = 1e-4  # of robust: share of the frequency a step


def sampled(values, first=0, spacing=SPACING):
    return [(first + spacing * number, float(value)) for number, value in enumerate(values)]


def fires(test, values, hits, rate=RATE, inverse_distance=1.0):
    """The iteration at which so many verdicts in a row agree, or None."""
    samples, run = sampled(values, SPACING), 0
    for end in range(1, len(samples) + 1):
        converged = judge(test, samples[:end], rate, inverse_distance).converged
        run = run + 1 if converged else 0
        if run == hits:
            return samples[end - 1][0]
    return None


def saturating(tau, until=20_000, noise=0.0, seed=0):
    """10 (1 - exp(-t / tau)) at t = 100, 200, ..., with noise, a share of the final value."""
    t = np.arange(SPACING, until + 1, SPACING)
    rng = np.random.default_rng(seed)
    return 10 * (1 - np.exp(-t / tau)) + 10 * noise * rng.normal(size=len(t))


@pytest.mark.parametrize("test, least", [("robust", MEDIAN_OF + 1), ("paper", 2), ("release", WINDOW)])
def test_too_few_samples_decide_nothing(test, least):
    for count in range(least):
        verdict = judge(test, sampled([5.0] * count), RATE, 1.0)
        assert verdict.slope is None and not verdict.converged
    assert judge(test, sampled([5.0] * least), RATE, 1.0).converged


@pytest.mark.parametrize("test", TESTS)
def test_a_sample_that_is_not_finite_counts_as_none(test):
    values = list(saturating(700, 1500))
    samples = sampled(values, SPACING)
    spoilt = [(50, np.nan), *samples[:9], (950, np.inf), *samples[9:], (1601, np.nan)]
    clean = judge(test, samples, RATE, 0.01)
    assert clean.slope is not None
    assert judge(test, spoilt, RATE, 0.01) == clean
    assert judge(test, [(100, np.nan)] * 9, RATE, 0.01).slope is None


@pytest.mark.parametrize("spacing", [1, 37, 100])
def test_straight_lines(spacing):
    """Slopes are a step, whatever lies between two looks."""
    samples = sampled(3 + 0.02 * spacing * np.arange(10), 500, spacing)
    for test in TESTS:
        assert judge(test, samples, RATE, 2.0).slope == pytest.approx(0.02)
    assert judge("robust", samples, RATE, 2.0).threshold == pytest.approx(RATE * samples[-1][1])
    assert judge("paper", samples, RATE, 2.0).threshold == pytest.approx(2 * RATE)
    assert judge("release", samples, RATE, 2.0).threshold == pytest.approx(SLOPE_SHARE * 0.02)


def test_the_paper_looks_at_the_last_difference_only():
    rises = [1, 5, 9, 13, 13.001]
    assert judge("paper", sampled(rises), 5e-5, 1.0).converged
    assert not judge("paper", sampled([*rises, 13.1]), 5e-5, 1.0).converged
    assert judge("paper", sampled([*rises, 13.1]), 5e-5, 100.0).converged


@pytest.mark.parametrize("unit", [1e-3, 1.0, 40.0])
def test_the_unit_of_length_does_not_matter(unit):
    """Frequencies and mean(1/d) are both 1 / length."""
    values, inverse_distance = saturating(900, 4000, 0.002), 30.0
    for test in TESTS:
        # the release's window must not sit on its threshold
        for end in (3, 8, 20, 40):
            here, there = (judge(test, sampled(values[:end] / u), RATE, inverse_distance / u) for u in (1.0, unit))
            assert here.converged == there.converged
            if here.slope is not None:
                assert there.slope == pytest.approx(here.slope / unit, abs=1e-12 / unit)


@pytest.mark.parametrize("test", TESTS)
@pytest.mark.parametrize("value", [0.1, 7.3, 123456.7])
def test_a_constant_is_flat(test, value):
    """Not at the mercy of rounding (release: of its fit)."""
    for count in range(WINDOW, 30):
        assert judge(test, sampled([value] * count), RATE, 1.0).converged


def test_falling():
    """The paper's inequality holds; the released code waits for growth, and so never leaves."""
    falling = sampled(np.linspace(9, 5, 12))
    assert judge("robust", falling, RATE, 1.0).converged
    assert judge("paper", falling, RATE, 1.0).converged
    for end in range(13):
        assert not judge("release", falling[:end], RATE, 1.0).converged


@pytest.mark.parametrize("place", range(1, MEDIAN_OF + 1))
@pytest.mark.parametrize("jump", [-3.0, 3.0])
def test_a_step_among_the_differences_decides_nothing(place, jump):
    """A prune or a burst moves every later sample: one difference of the three."""
    for rate, converged in ((0.0, True), (5 * RATE, False)):
        values = 10 * (1 + rate * SPACING * np.arange(9))
        values[-place:] += jump
        assert judge("robust", sampled(values), RATE, 1.0).converged is converged


@pytest.mark.parametrize("tau", [100, 300, 1000, 3000])
@pytest.mark.parametrize("noise", [0.0, 0.001, 0.005])
def test_robust_always_fires(tau, noise):
    """Where the released detector waits for ever: fast growth, or noise of half a per cent."""
    for seed in range(5):
        first = fires("robust", saturating(tau, noise=noise, seed=seed), hits=2)
        assert first is not None and first <= 400 + 4 * tau, (seed, first)


@pytest.mark.parametrize("tau", [300, 1000, 3000])
def test_robust_does_not_fire_while_much_is_to_come(tau):
    """Without noise, not before the curve grows by less than RATE of itself a step."""
    t = np.arange(SPACING, 20_000, SPACING)
    relative = np.exp(-t / tau) / tau / (1 - np.exp(-t / tau))
    due = t[np.argmax(relative < RATE)]
    assert due <= fires("robust", saturating(tau), hits=1) <= due + MEDIAN_OF * SPACING
