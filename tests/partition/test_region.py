"""Spaces and regions: which cell owns a point, how far a margin reaches, and records in files."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clsplat.partition.region import DAMAGED, Region, Space, in_parts, quantiles

RNG = np.random.default_rng(7)
UTM = np.array([5.4e6, 4.2e5, 300.0])


def space(contracted=False, seed=0, origin=(1.0, 2.0, 3.0)):
    rotation = Rotation.random(random_state=seed).as_matrix()
    return Space(rotation, origin, (4.0, 5.0, 2.0), contracted)


def at(where, *along):
    """The world point at these coordinates along u, v and up, in half sides from the origin."""
    return (where.origin + np.array(along) * where.half @ where.rotation)[None]


def test_coordinates_are_half_sides_from_the_origin():
    where = space()
    assert np.allclose(where.to(at(where, 0.5, -3, 1)), [[0.5, -3, 1]])
    assert where.to(where.origin + 4 * where.rotation[0][None])[0, 0] == pytest.approx(1)


@pytest.mark.parametrize(
    "along, expected",
    [
        ((0, 0, 0), (0.5, 0.5, 0.5)),
        ((1, -1, 0.5), (0.75, 0.25, 0.625)),  # the area itself is only scaled
        ((2, 0, 0), (0.875, 0.5, 0.5)),  # (2 - 1/2) / 4 + 1/2
        ((2, -1, 0), (0.875, 0.3125, 0.5)),  # the largest decides for all: -1/2 of 3/2
        ((0, 0, -4), (0.5, 0.5, 0.0625)),
        ((1e30, 0, 0), (1, 0.5, 0.5)),
    ],
)
def test_contraction_by_hand(along, expected):
    where = space(contracted=True)
    assert where.to(at(where, *along)) == pytest.approx(np.array([expected]), abs=1e-12)


@pytest.mark.parametrize("contracted", [False, True])
def test_world_is_the_inverse_of_to(contracted):
    where = space(contracted, origin=UTM)
    points = UTM + RNG.normal(0, 20, (500, 3))
    assert np.abs(where.world(where.to(points)) - points).max() < 1e-7


@pytest.mark.parametrize("contracted", [False, True])
def test_a_border_belongs_to_the_upper_cell(contracted):
    where = Space(np.eye(3), np.zeros(3), np.ones(3), contracted)
    lower, upper = Region(where).cut(1, where.to(np.array([[0, 0.25, 0]]))[0, 1])
    points = np.array([[0, 0.25 - 1e-9, 0], [0, 0.25, 0], [0, 1e300, 0]])
    assert lower.owns(points).tolist() == [True, False, False]
    assert upper.owns(points).tolist() == [False, True, True]


@pytest.mark.parametrize("contracted", [False, True])
def test_points_that_are_not_finite_have_no_owner(contracted):
    points = np.array([[np.nan, 0, 0], [np.inf, 0, 0], [0, -np.inf, np.inf], [-np.inf, 0, 0]])
    diagonal = np.linalg.qr([[1.0, 1, 0], [1, 0, 1], [1, 0, 0]])[0]  # x is along all three axes
    diagonal *= np.sign(diagonal[:, :1])
    for rotation in (diagonal, np.eye(3)):
        where = Space(rotation, np.zeros(3), np.ones(3), contracted)
        assert not Region(where).owns(points).any()


def test_a_cell_reaches_all_points_within_its_margin():
    for seed in range(20):
        where = space(contracted=seed % 2 == 1, seed=seed)
        rng = np.random.default_rng(seed)
        low = Region(where).side * rng.uniform(0, 0.4, 3) - (0 if where.contracted else 1)
        cell = Region(where, low, low + 0.3, 0.2)
        points = where.origin + rng.normal(0, 10, (2000, 3))
        coordinates = where.to(points)
        away = np.maximum(cell.low - coordinates, coordinates - cell.high).max(axis=1)
        assert cell.reaches(points)[cell.owns(points)].all()
        assert (cell.reaches(points) == (away < 0.3 * 0.2)).all()


def test_a_cell_reaches_points_whose_spread_lies_in_it():
    turned = Rotation.from_euler("z", 90, degrees=True).as_matrix()  # u is the world's y, v its -x
    cell = Region(
        Space(turned, UTM, np.array([10.0, 10, 10])), (-0.5, -np.inf, -np.inf), (0.5, np.inf, np.inf), 0.2
    )  # |u| < 0.7 with the margin; v has no end
    points = UTM + np.array([[0, 3.0, 0]] * 3 + [[50, 0, 99], [0, 7.5, 0]])
    assert cell.reaches(points).tolist() == [True] * 4 + [False]
    assert cell.reaches(points, np.array([3.9, 4.1, 9.9, 6.9, 0])).tolist() == [True, False, False, True, False]
    assert cell.reaches(points, np.array([0, 0, 10.1, 7.1, 0])).tolist() == [True, True, False, False, False]


@pytest.mark.parametrize("seed", range(12))
def test_points_far_inside_need_no_steps(seed):
    """As if the four steps were taken from every point; of spreads of all sizes."""
    rng, where = np.random.default_rng(seed), space(contracted=seed % 2 == 1, seed=seed)
    low = Region(where).side * rng.uniform(0, 0.4, 3) - (0 if where.contracted else 1)
    cell = Region(where, low, low + rng.uniform(0.1, 0.5, 3), 0.2)
    around = low + rng.uniform(-0.2, 0.7, (5000, 3))
    points = where.world(around.clip(0.01, 0.99) if where.contracted else around)
    spread = where.half.min() * np.exp(rng.uniform(-6, 0, 5000)) * (rng.random(5000) < 0.9)
    expected = cell.reaches(points)
    for step in (*where.rotation[:2], *-where.rotation[:2]):
        expected &= cell.reaches(points + spread[:, None] * step)
    assert np.array_equal(cell.reaches(points, spread), expected)
    assert 10 < expected.sum() < cell.reaches(points).sum()


def test_the_map_has_x_and_y_where_z_is_up():
    points = UTM + RNG.normal(0, 20, (50, 3))
    turned = Space(Rotation.from_euler("z", 1).as_matrix(), UTM, np.ones(3))
    assert np.array_equal(turned.map(points), points[:, :2])


def test_a_map_is_seen_from_above():
    for seed in range(50):
        where = space(seed=seed)
        if seed == 0:
            where = Space(np.diag([1.0, -1, -1]), np.zeros(3), np.ones(3))
        u, v, up = (
            where.map(where.origin + axis[None])[0] - where.map(where.origin[None])[0] for axis in where.rotation
        )
        assert np.allclose(up, 0) and np.allclose([u @ u, v @ v, u @ v], [1, 1, 0])
        assert u[0] * v[1] - u[1] * v[0] == pytest.approx(1)  # not mirrored


@pytest.mark.parametrize(
    "change",
    [
        {"low": [0, 0]},
        {"low": [1, 1, "x"]},
        {"low": [2, 0, 0]},
        {"high": [0, 1, 1]},
        {"low": None},
        {"margin": -0.1},
        {"margin": None},
        {"margin": 1e400},
        {"space": None},
        {"space": {}},
        {"low": [float("nan"), 0, 0]},
        *(
            {"space": {**space().record(), **change}}
            for change in (
                {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 2]]},
                {"rotation": [1, 0, 0]},
                {"half": [1, 0, 1]},
                {"half": [1, -1, 1]},
                {"half": "no"},
                {"origin": [0, 0]},
                {"origin": [0, 0, float("inf")]},
            )
        ),
    ],
)
def test_a_damaged_record_is_refused(change):
    record = {**Region(space(), (0, 0, 0), (1, 1, 1), 0.1).record(), **change}
    with pytest.raises(DAMAGED):
        Region.from_record(record)
    with pytest.raises(DAMAGED):
        Region.from_record({key: value for key, value in record.items() if key not in change})


def test_rows_are_taken_in_parts_in_their_order(monkeypatch):
    monkeypatch.setattr("clsplat.partition.region.PART_ROWS", 7)
    first, second = np.random.default_rng(0).normal(size=(2, 40, 3))
    for count in (0, 6, 7, 8, 40):
        found = in_parts(lambda a, b: a[:, 0] < b[:, 1], first[:count], second[:count])
        assert np.array_equal(found, first[:count, 0] < second[:count, 1]), count


def test_quantiles_of_many_values_are_those_of_evenly_spaced_ones(monkeypatch):
    values, weights = np.random.default_rng(0).random((2, 5000))
    whole = quantiles(values, weights, (0.01, 0.5, 0.99))
    monkeypatch.setattr("clsplat.partition.region.MOST_RANKED", 1000)
    assert quantiles(values, weights, (0.01, 0.5, 0.99)) == pytest.approx(whole, abs=0.02)
    assert quantiles(values, weights, (0.5,)) == quantiles(values[::5], weights[::5], (0.5,))
