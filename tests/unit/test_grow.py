"""Decisions of densification on hand-made rows: who is cloned, split and pruned, and into what."""

import numpy as np
import pytest

from clsplat.densify.grow import plan_growth
from clsplat.options import TrainOptions
from tests.reference.project import rotations

EXTENT = 10.0
OPTIONS = TrainOptions(grow_threshold=1.0)
# splits above 0.1, pruned above 1.0; HUGE / 1.6 is below
SMALL, LARGE, HUGE, GIANT = 0.05, 0.2, 1.1, 2.0
FAINT, SOLID = 0.004, 0.5
STILL, MOVING = 0.5, 1.0  # mean screen gradients below and at the threshold


def rows_of(scales, opacities, seed=0):
    """Rows whose largest scales are `scales`, world units, the other axes thinner."""
    rng = np.random.default_rng(seed)
    count, opacities = len(scales), np.asarray(opacities, float)
    return {
        "positions": rng.normal(size=(count, 3)).astype(np.float32),
        "log_scales": np.log(np.outer(scales, [0.3, 1, 0.1])).astype(np.float32),
        "quaternions": rng.normal(size=(count, 4)).astype(np.float32) * 3,
        "opacity_logits": np.log(opacities / (1 - opacities)).astype(np.float32)}


def grown(kinds, prune_large=False, seed=0, **changes):
    """(Growth, rows) of gaussians given as (scale, opacity, gradient)."""
    scales, opacities, gradient = map(np.array, zip(*kinds))
    rows = rows_of(scales, opacities)
    return plan_growth(gradient, rows, EXTENT, TrainOptions(grow_threshold=1.0, **changes),
                       prune_large, np.random.default_rng(seed)), rows


KINDS = [  # name, (scale, opacity, gradient), how often it is there afterwards
    ("still", (SMALL, SOLID, STILL), [True, 0, 0]),
    ("cloned", (SMALL, SOLID, MOVING), [True, 1, 0]),
    ("split", (LARGE, SOLID, MOVING), [False, 0, 2]),
    ("large but still", (LARGE, SOLID, STILL), [True, 0, 0]),
    ("faint", (SMALL, FAINT, STILL), [False, 0, 0]),
    ("faint and moving", (SMALL, FAINT, MOVING), [False, 0, 0]),
    ("faint, large and moving", (LARGE, FAINT, MOVING), [False, 0, 0]),
    ("giant", (GIANT, SOLID, STILL), [True, 0, 0]),
    ("giant and moving", (GIANT, SOLID, MOVING), [False, 0, 2]),
]
LARGE_KINDS = [
    ("giant", (GIANT, SOLID, STILL), [False, 0, 0]),
    ("giant and moving", (GIANT, SOLID, MOVING), [False, 0, 0]),
    ("huge", (HUGE, SOLID, STILL), [False, 0, 0]),
    ("huge and moving", (HUGE, SOLID, MOVING), [False, 0, 2]),
    ("large", (LARGE, SOLID, MOVING), [False, 0, 2]),
]


@pytest.mark.parametrize("kinds, prune_large", [(KINDS, False), (LARGE_KINDS, True)])
def test_decisions(kinds, prune_large):
    growth, _ = grown([values for _, values, _ in kinds], prune_large)
    stay, clones, children = (np.bincount(part, minlength=len(kinds)) for part in (
        growth.source[:growth.kept], growth.source[growth.kept:growth.split.start],
        growth.source[growth.split]))
    for k, (name, _, expected) in enumerate(kinds):
        assert [bool(stay[k]), clones[k], children[k]] == expected, name


def test_rows_come_in_order_and_are_counted():
    growth, _ = grown([values for _, values, _ in KINDS])
    assert growth.source.tolist() == [0, 1, 3, 7, 1, 2, 2, 8, 8]
    assert growth.source.dtype == np.uint32
    assert (growth.kept, growth.split, growth.cloned) == (4, slice(5, 9), 1)
    assert growth.pruned == 3
    assert len(growth.source) == len(KINDS) + growth.cloned + 2 - growth.pruned


def test_children_are_smaller_and_lie_as_the_parent_did():
    """Places are drawn from the parent: mean its position, covariance R S^2 R^T."""
    scales = np.array([0.4, 0.9, 0.15])
    rows = rows_of([0.9], [SOLID], seed=3)
    rows["log_scales"][:] = np.log(scales)
    count = 20000
    many = {name: np.repeat(values, count, axis=0) for name, values in rows.items()}
    growth = plan_growth(np.ones(count), many, EXTENT, OPTIONS, False, np.random.default_rng(1))
    assert len(growth.positions) == 2 * count
    assert np.allclose(growth.log_scales, np.log(scales / 1.6), atol=1e-6)

    turn = rotations(rows["quaternions"].astype(float))[0][0]
    local = (growth.positions - rows["positions"][0].astype(float)) @ turn / scales
    error = 1 / np.sqrt(2 * count)  # of a mean of unit normal numbers
    assert np.abs(local.mean(axis=0)).max() < 5 * error
    assert np.abs(np.cov(local.T) - np.eye(3)).max() < 5 * np.sqrt(2) * error


def test_cap_takes_the_highest_gradients():
    gradients = np.array([1, 7, 3, 0.5, 9, 5, 8])
    scales = [SMALL, SMALL, LARGE, SMALL, LARGE, SMALL, SMALL]
    for cap, winners in ((7, []), (8, [4]), (9, [4, 6]), (11, [1, 4, 5, 6]), (5, []),
                         (0, [0, 1, 2, 4, 5, 6]), (100, [0, 1, 2, 4, 5, 6])):
        growth, _ = grown(list(zip(scales, [SOLID] * 7, gradients)), max_gaussians=cap)
        assert len(growth.source) == 7 + len(winners)
        assert sorted(set(growth.source[growth.kept:])) == winners, cap


def test_cap_with_equal_gradients_takes_the_first():
    growth, _ = grown([(SMALL, SOLID, 2.0)] * 6, max_gaussians=8)
    assert growth.source[growth.kept:].tolist() == [0, 1]


def test_the_generator_decides_places_and_nothing_else():
    kinds = [values for _, values, _ in KINDS]
    first, again, other = (grown(kinds, seed=seed)[0] for seed in (5, 5, 6))
    assert np.array_equal(first.positions, again.positions)
    assert np.array_equal(first.source, other.source)
    assert (first.positions != other.positions).all()


def test_pruning_one_split_does_not_move_the_children_of_another():
    kinds = [(LARGE, SOLID, MOVING)] * 3
    faint = [kinds[0], (LARGE, FAINT, MOVING), kinds[2]]
    (whole, _), (less, _) = grown(kinds), grown(faint)
    assert np.array_equal(less.positions, whole.positions[[0, 1, 4, 5]])


def test_all_may_be_pruned():
    growth, _ = grown([(SMALL, FAINT, STILL)] * 4)
    assert (len(growth.source), growth.kept, growth.pruned) == (0, 0, 4)
    assert growth.positions.shape == (0, 3)
