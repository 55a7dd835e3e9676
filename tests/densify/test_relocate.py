"""Relocation: who becomes a copy of whom, and what copies share."""

from math import comb, sqrt

import numpy as np
import pytest

from clsplat.densify.grow import plan_relocation, shared

LEAST = 0.005


def by_sums(opacity, number):
    """The shared opacity and the factor of size, by the double sum of Kheradmand et al., eq. 9."""
    each = 1 - (1 - opacity) ** (1 / number)
    total = sum(
        comb(i - 1, k) * (-1) ** k * each ** (k + 1) / sqrt(k + 1) for i in range(1, number + 1) for k in range(i)
    )
    return each, opacity / total


def relocated(opacities, dead=(), frozen=(), added=0, seed=0):
    """The Growth for gaussians of some opacities, and their new opacities and scales."""
    opacities = np.asarray(opacities, float)
    logits = np.log(opacities / (1 - opacities)).astype(np.float32)
    scales = np.arange(3 * len(opacities), dtype=np.float32).reshape(-1, 3) / 10
    masks = [np.isin(np.arange(len(opacities)), list(rows)) for rows in (dead, frozen)]
    growth = plan_relocation(logits, scales, *masks, added, LEAST, np.random.default_rng(seed))
    new = {"opacity_logits": logits[growth.source], "log_scales": scales[growth.source]}
    for name, (first, values) in growth.changes.items():
        assert values.dtype == np.float32 and first + len(values) == len(growth.source)
        new[name][first:] = values
    return growth, 1 / (1 + np.exp(-new["opacity_logits"].astype(float))), new["log_scales"]


@pytest.mark.parametrize("opacity", [0.005, 0.1, 0.5, 0.9, 0.999])
@pytest.mark.parametrize("number", [1, 2, 3, 10, 40])
def test_shares_are_those_of_the_paper(opacity, number):
    each, shrink = shared(np.array([opacity]), np.array([number]))
    assert (each[0], shrink[0]) == pytest.approx(by_sums(opacity, number), rel=1e-9)


def test_shares_keep_what_a_line_across_sees():
    x = np.linspace(-12, 12, 20001)
    for opacity, number in ((0.3, 2), (0.95, 7), (0.6, 500)):
        each, shrink = (values[0] for values in shared(np.array([opacity]), np.array([number])))
        one = opacity * np.exp(-(x**2) / 2)
        many = 1 - (1 - each * np.exp(-((x / shrink) ** 2) / 2)) ** number
        assert many.sum() == pytest.approx(one.sum(), rel=1e-6)
        assert many.max() == pytest.approx(opacity)


def test_the_dead_become_copies_of_live_ones():
    growth, opacities, scales = relocated([0.8, 0.003, 0.4, 0.004, 0.6], dead=(1, 3))
    assert len(growth.source) == 5 and (growth.cloned, growth.pruned, growth.split) == (2, 2, 0)
    assert not {1, 3} & set(growth.source.tolist())
    assert growth.source[: growth.kept].tolist() == sorted(set(growth.source[: growth.kept].tolist()))
    before = np.array([0.8, 0.003, 0.4, 0.004, 0.6])
    rows, times = np.unique(growth.source, return_counts=True)
    for row, number in zip(rows, times):
        each, shrink = by_sums(before[row], int(number))
        own = growth.source == row
        assert opacities[own] == pytest.approx(each, rel=1e-5)
        assert scales[own] == pytest.approx(
            np.tile(np.arange(3 * row, 3 * row + 3) / 10 + np.log(shrink), (number, 1)), abs=1e-5
        )
        # the moments of all that share begin anew
        assert (own[: growth.kept].sum() == 1) == (number == 1)


def test_copies_are_drawn_in_proportion_to_opacity():
    opacities = np.array([0.1, 0.2, 0.4, 0.004])
    growth, after, _ = relocated(opacities, dead=(3,), added=100_000)
    assert len(growth.source) == 100_004 and growth.cloned == 100_001
    share = np.bincount(growth.source, minlength=4) / len(growth.source)
    assert share == pytest.approx(np.array([1, 2, 4, 0]) / 7, abs=0.01)
    assert after.min() >= LEAST * (1 - 1e-6)  # or the copies would be dead at once


def test_what_is_fixed_stays_and_is_not_copied():
    growth, opacities, scales = relocated([0.9, 0.001, 0.5, 0.001], dead=(1, 3), frozen=(0, 1), added=3)
    assert (growth.cloned, growth.pruned) == (4, 1)
    assert growth.source.tolist() == [0, 1, 2, 2, 2, 2, 2] and growth.kept == 2
    assert opacities[:2] == pytest.approx([0.9, 0.001], rel=1e-5)
    assert np.array_equal(scales[:2], np.arange(6).reshape(2, 3).astype(np.float32) / 10)


@pytest.mark.parametrize("dead, frozen, added", [((), (), 0), ((0, 1, 2), (), 5), ((0,), (1, 2), 5)])
def test_nothing_to_do_or_nobody_to_copy(dead, frozen, added):
    growth, opacities, _ = relocated([0.5, 0.5, 0.5], dead, frozen, added)
    assert growth.source.tolist() == [0, 1, 2] and growth.kept == 3 and not growth.changes
