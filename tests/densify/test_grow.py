"""Decisions of densification on hand-made rows: clones, splits, prunes and the new rows."""

import numpy as np
import pytest

from clsplat.densify.grow import plan_growth
from clsplat.densify.round import Round
from clsplat.options import TrainOptions
from tests.reference.project import rotations

EXTENT = 10.0
# splits above 0.1, pruned above 1.0; HUGE / 1.6 is below
SMALL, LARGE, HUGE, GIANT = 0.05, 0.2, 1.1, 2.0
FAINT, SOLID = 0.004, 0.5
STILL, MOVING = False, True  # whether it was chosen to grow


def rows_of(scales, opacities, seed=0):
    """Rows whose largest scales are `scales`, world units, the other axes thinner."""
    rng = np.random.default_rng(seed)
    count, opacities = len(scales), np.asarray(opacities, float)
    return {
        "positions": rng.normal(size=(count, 3)).astype(np.float32),
        "log_scales": np.log(np.outer(scales, [0.3, 1, 0.1])).astype(np.float32),
        "quaternions": rng.normal(size=(count, 4)).astype(np.float32) * 3,
        "opacity_logits": np.log(opacities / (1 - opacities)).astype(np.float32),
    }


def round_of(rows, prunes_large=False, seed=0, **changes):
    """A round of growth after the step of the number of a seed."""
    return Round(
        seed,
        rows,
        EXTENT,
        TrainOptions(**changes),
        prunes_large,
        np.zeros(len(rows["positions"]), bool),
        None,
        None,
        None,
    )


def growth_of(rows, moving, prunes_large=False, seed=0, **changes):
    return round_of(rows, prunes_large, seed, prune_size=0.1, **changes).densify(np.array(moving, bool))


def grown(kinds, prunes_large=False, seed=0):
    """(Growth, rows) of gaussians given as (scale, opacity, whether it moves)."""
    scales, opacities, moving = map(np.array, zip(*kinds))
    rows = rows_of(scales, opacities)
    return growth_of(rows, moving, prunes_large, seed), rows


def applied(growth, rows):
    """The rows after growth."""
    after = {name: values[growth.source] for name, values in rows.items()}
    for name, (first, values) in growth.changes.items():
        assert values.dtype == np.float32
        after[name][first : first + len(values)] = values
    return after


def parts(growth):
    """The old rows of what stays, of clones and of children."""
    first = growth.kept + growth.cloned
    return growth.source[: growth.kept], growth.source[growth.kept : first], growth.source[first:]


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


@pytest.mark.parametrize("kinds, prunes_large", [(KINDS, False), (LARGE_KINDS, True)])
def test_decisions(kinds, prunes_large):
    growth, _ = grown([values for _, values, _ in kinds], prunes_large)
    stay, clones, children = (np.bincount(part, minlength=len(kinds)) for part in parts(growth))
    for k, (name, _, expected) in enumerate(kinds):
        assert [bool(stay[k]), clones[k], children[k]] == expected, name


def test_rows_come_in_order_and_are_counted():
    growth, _ = grown([values for _, values, _ in KINDS])
    assert growth.source.tolist() == [0, 1, 3, 7, 1, 2, 2, 8, 8]
    assert growth.source.dtype == np.uint32
    assert (growth.kept, growth.cloned, growth.split, growth.pruned) == (4, 1, 2, 3)
    assert {name: (first, len(values)) for name, (first, values) in growth.changes.items()} == {
        "positions": (5, 4),
        "log_scales": (5, 4),
    }


@pytest.mark.parametrize("name, value", [("opacity_logits", np.nan), ("log_scales", np.nan), ("log_scales", np.inf)])
@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
def test_what_is_no_number_is_pruned_with_its_children(name, value):
    rows = rows_of([LARGE, SMALL] * 2, [SOLID] * 4)
    rows[name][:2] = value
    growth = growth_of(rows, [MOVING] * 4)
    assert growth.source.tolist() == [3, 3, 2, 2]
    assert growth.pruned == 2


def test_what_is_spared_stays_and_what_is_not_chosen_does_not_grow():
    """The masks decide, not the round's own pruning (Taming 3DGS spares half)."""
    rows = rows_of([SMALL] * 4, [FAINT, FAINT, SOLID, SOLID])
    assert round_of(rows).prunes.tolist() == [True, True, False, False]
    growth = plan_growth(round_of(rows), np.array([0, 0, 0, 1], bool), np.array([1, 0, 1, 0], bool))
    assert growth.source.tolist() == [1, 3, 3]


def test_children_are_smaller_and_lie_as_the_parent_did():
    """Places are drawn from the parent: mean its position, covariance R S^2 R^T."""
    scales = np.array([0.4, 0.9, 0.15])
    rows = rows_of([0.9], [SOLID], seed=3)
    rows["log_scales"][:] = np.log(scales)
    count = 20000
    many = {name: np.repeat(values, count, axis=0) for name, values in rows.items()}
    after = applied(growth_of(many, np.ones(count), seed=1), many)
    assert len(after["positions"]) == 2 * count
    assert np.allclose(after["log_scales"], np.log(scales / 1.6), atol=1e-6)

    turn = rotations(rows["quaternions"].astype(float))[0][0]
    local = (after["positions"] - rows["positions"][0].astype(float)) @ turn / scales
    error = 1 / np.sqrt(2 * count)  # of a mean of unit normal numbers
    assert np.abs(local.mean(axis=0)).max() < 5 * error
    assert np.abs(np.cov(local.T) - np.eye(3)).max() < 5 * np.sqrt(2) * error


def test_what_stays_and_what_is_cloned_does_not_change():
    growth, rows = grown([values for _, values, _ in KINDS])
    after = applied(growth, rows)
    for name, values in rows.items():
        assert np.array_equal(after[name][:5], values[[0, 1, 3, 7, 1]]), name


def test_pruning_one_split_does_not_move_the_children_of_another():
    kinds = [(LARGE, SOLID, MOVING)] * 3
    faint = [kinds[0], (LARGE, FAINT, MOVING), kinds[2]]
    whole, less = (grown(given)[0].changes["positions"][1] for given in (kinds, faint))
    assert np.array_equal(less, whole[[0, 1, 4, 5]])


def with_spheres(rows, distances, max_offset=1.0, axis=0):
    """The rows with anchors at these distances along an axis, and distinct max_offsets."""
    anchors = rows["positions"].copy()
    anchors[:, axis] -= np.float32(distances)
    count = len(anchors)
    return {
        **rows,
        "anchors": anchors,
        "max_offsets": np.float32(max_offset) * (1 + np.arange(count, dtype=np.float32) / 1024),
    }


def test_the_strayed_are_pruned_whatever_else_they_do():
    kinds = [(SMALL, STILL), (SMALL, MOVING), (LARGE, STILL), (LARGE, MOVING)]
    scales, moving = zip(*kinds * 2)
    rows = with_spheres(rows_of(scales, [SOLID] * 8), [0.0] * 4 + [2.5] * 4)
    growth = growth_of(rows, moving, sphere_reach=2.0)
    assert growth.source.tolist() == [0, 1, 2, 1, 3, 3]
    assert growth.pruned == 4
    wider = growth_of(rows, moving, sphere_reach=4.0)
    assert wider.source.tolist() == [0, 1, 2, 4, 5, 6, 1, 5, 3, 3, 7, 7]


def test_a_clone_is_anchored_where_it_stands_and_inherits_its_reach():
    rows = with_spheres(rows_of([SMALL] * 3, [SOLID] * 3), [0.5, 0.25, 0.125])
    growth = growth_of(rows, [MOVING, STILL, MOVING])
    after = applied(growth, rows)
    assert growth.source.tolist() == [0, 1, 2, 0, 2]
    assert np.array_equal(after["anchors"][:3], rows["anchors"])
    assert np.array_equal(after["anchors"][3:], rows["positions"][[0, 2]])
    assert np.array_equal(after["max_offsets"], rows["max_offsets"][growth.source])


@pytest.mark.parametrize("rule, shrink", [("paper", 0.7), ("release", 0.8)])
def test_spheres_of_children_follow_the_rule(rule, shrink):
    """And those of the clones before them in the same round stay right."""
    rows = with_spheres(rows_of([SMALL, LARGE, LARGE, SMALL], [SOLID] * 4), [0.5] * 4)
    growth = growth_of(rows, [MOVING, MOVING, STILL, STILL], sphere_rule=rule, sphere_shrink=shrink)
    assert growth.source.tolist() == [0, 2, 3, 0, 1, 1]
    after = applied(growth, rows)
    own = after["positions"][4:]
    assert np.array_equal(after["anchors"][4:], own if rule == "release" else rows["anchors"][[1, 1]])
    assert np.allclose(after["max_offsets"][4:], shrink * rows["max_offsets"][1], rtol=1e-6)
    assert np.array_equal(after["anchors"][:4], [*rows["anchors"][[0, 2, 3]], rows["positions"][0]])
    assert np.array_equal(after["max_offsets"][:4], rows["max_offsets"][[0, 2, 3, 0]])


def test_a_child_outside_the_shrunken_sphere_is_dropped_at_once():
    """Of both children, of one or of none; the others do not move."""
    count, reach, shrink = 300, 2.0, 0.7
    rows = with_spheres(rows_of([LARGE] * count, [SOLID] * count), np.linspace(0, 1.9, count), max_offset=1.0)
    settings = dict(sphere_reach=reach, sphere_shrink=shrink)
    free = {name: rows[name] for name in rows if name not in ("anchors", "max_offsets")}
    places = growth_of(free, [MOVING] * count).changes["positions"][1]
    parents = np.repeat(np.arange(count), 2)
    distance = np.linalg.norm(places.astype(float) - rows["anchors"][parents], axis=1)
    inside = distance <= reach * shrink * rows["max_offsets"][parents].astype(float)
    both = np.bincount(parents[inside], minlength=count)
    assert min(np.bincount(both)) > 3  # parents with none, one and two children inside

    growth = growth_of(rows, [MOVING] * count, **settings)
    after = applied(growth, rows)
    assert np.array_equal(growth.source, parents[inside])
    assert np.array_equal(after["positions"], places[inside])
    assert (growth.split, growth.pruned) == ((both > 0).sum(), (both == 0).sum())
    released = growth_of(rows, [MOVING] * count, sphere_rule="release", **settings)
    assert len(released.source) == 2 * count
