"""Masks of growth and pruning: which are chosen, how many, and with what probability."""

from functools import cache

import numpy as np
import pytest

from clsplat.densify.round import Round
from clsplat.options import resolve

GRADIENT = np.array([3.0, 1.0, 2.0, 3.0, 0.5, np.nan, 2.0, 0.0])


@cache  # several thousand draws use the same
def options_of(threshold):
    return resolve({}, {"grow_threshold": threshold})


def a_round(gradient, threshold=1.0, scores=None, small=None, prunes=None, rng=None):
    nothing = np.zeros(len(gradient), bool)
    rows = {"log_scales": np.zeros((len(gradient), 3)), "opacity_logits": np.zeros(len(gradient))}
    made = Round(1, rows, 1.0, options_of(threshold), False, nothing, lambda: gradient, lambda _: scores, None)
    made.rng, made.is_small = rng, small
    made.prunes = nothing if prunes is None else prunes
    return made


def above_threshold(gradient, threshold, room):
    return a_round(gradient, threshold).above_threshold(room)


def highest(gradient, room):
    return a_round(gradient).highest(room)


def by_score(scores, gradient, threshold, small, room, rng):
    return a_round(gradient, threshold, scores, small, rng=rng).by_score(room, np.zeros(len(gradient), bool))


def half_of(prunes, scores, rng):
    return a_round(scores, scores=scores, prunes=prunes, rng=rng).half_of_prunes()


def chosen(mask):
    assert mask.dtype == bool
    return list(np.flatnonzero(mask))


@pytest.mark.parametrize(
    "room, expected",
    [(None, [0, 2, 3, 6]), (9, [0, 2, 3, 6]), (4, [0, 2, 3, 6]), (3, [0, 2, 3]), (1, [0]), (0, []), (-2, [])],
)
def test_above_the_threshold(room, expected):
    """The threshold itself counts; the highest are chosen, among equals the first."""
    assert chosen(above_threshold(GRADIENT, 2.0, room)) == expected


@pytest.mark.parametrize(
    "count, expected", [(-1, []), (0, []), (1, [0]), (3, [0, 2, 3]), (6, [0, 1, 2, 3, 4, 6]), (20, [0, 1, 2, 3, 4, 6])]
)
def test_the_highest(count, expected):
    """Whatever the threshold, but never one that has no gradient."""
    assert chosen(highest(GRADIENT, count)) == expected


def test_nothing_to_choose_from():
    empty, rng = np.zeros(0), np.random.default_rng(0)
    for mask in (
        above_threshold(empty, 1, 3),
        highest(empty, 3),
        half_of(empty > 0, empty, rng),
        by_score(empty, empty, 1, empty > 0, 3, rng),
    ):
        assert mask.shape == (0,)
    still = np.zeros(5)
    assert not by_score(still + 1, still, 1, still > 0, 3, rng).any()


def a_population(count=400, seed=0):
    """scores, gradient, small: a quarter of the eligible are large."""
    rng = np.random.default_rng(seed)
    return rng.uniform(1, 9, count), rng.choice([0.5, 1.0], count), np.arange(count) % 4 > 0


@pytest.mark.parametrize("count", [0, 1, 10, 101, 10**6, -5])
def test_the_budget_is_shared_by_kind(count):
    scores, gradient, small = a_population()
    eligible = gradient >= 1.0
    mask = by_score(scores, gradient, 1.0, small, count, np.random.default_rng(1))
    assert not (mask & ~eligible).any()
    total = min(max(count, 0), eligible.sum())
    assert mask.sum() == total
    assert (mask & small).sum() == round(total * (eligible & small).sum() / eligible.sum())


def test_a_score_of_nothing_is_never_drawn():
    scores, gradient, small = a_population()
    scores[::3] = 0
    mask = by_score(scores, gradient, 1.0, small, 10**6, np.random.default_rng(1))
    assert np.array_equal(mask, (gradient >= 1) & (scores > 0))
    few = by_score(scores, gradient, 1.0, small, 50, np.random.default_rng(1))
    assert few.sum() == 50 and not few[::3].any()


def test_draws_follow_the_scores():
    """The first of two drawn is i with p_i, the second j with p_j / (1 - p_i)."""
    scores, trials = np.array([4.0, 3.0, 2.0, 1.0]), 4000
    p = scores / 10
    inclusion = [p[i] + sum(p[j] * p[i] / (1 - p[j]) for j in range(4) if j != i) for i in range(4)]
    ones = np.ones(4)
    rng = np.random.default_rng(2)
    drawn = sum(by_score(scores, ones, 1, ones > 0, 2, rng).astype(int) for _ in range(trials))
    assert np.abs(drawn / trials - inclusion).max() < 0.03
    gone = sum(half_of(ones > 0, 1 / scores, rng).astype(int) for _ in range(trials))
    assert np.abs(gone / trials - inclusion).max() < 0.03


@pytest.mark.parametrize("count", [0, 1, 2, 7, 8])
def test_half_of_the_candidates(count):
    candidates = np.arange(20) % 20 >= 20 - count
    mask = half_of(candidates, np.ones(20), np.random.default_rng(3))
    assert mask.sum() == count // 2 and not (mask & ~candidates).any()


def test_candidates_without_a_score_go_first_and_by_chance():
    candidates = np.ones(20, bool)
    scores = np.where(np.arange(20) < 12, 0.0, 1e-9)
    masks = [half_of(candidates, scores, np.random.default_rng(seed)) for seed in range(9)]
    assert all(mask[:12].sum() == 10 for mask in masks)
    assert len({mask.tobytes() for mask in masks}) > 5


def test_who_was_ineligible_does_not_move_the_draws_of_others():
    scores, gradient, small = a_population()
    first = by_score(scores, gradient, 1.0, small, 50, np.random.default_rng(6))
    changed = np.where(gradient < 1, 7.0, scores)
    assert np.array_equal(first, by_score(changed, gradient, 1.0, small, 50, np.random.default_rng(6)))
