"""Distances to the nearest points: against all pairs, with duplicates, twins and too few points."""

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.gaussians import Gaussians, mean_inverse_distance, mean_neighbour_distance, neighbour_distance

POINTS = np.random.default_rng(2).normal(size=(60, 3)) * [9, 3, 0.1]


def all_pairs(points):
    """Distances to the other points, nearest first."""
    return np.sort(np.linalg.norm(points[:, None] - points, axis=2), axis=1)[:, 1:]


@pytest.mark.parametrize("neighbours", [1, 2, 3, 15, 59])
def test_against_all_pairs(neighbours):
    nearest = all_pairs(POINTS)[:, :neighbours]
    assert np.allclose(mean_neighbour_distance(POINTS, neighbours), nearest.mean(axis=1))
    assert np.allclose(neighbour_distance(POINTS, neighbours), np.sqrt((nearest**2).mean(axis=1)))


def test_the_inverse_against_all_pairs():
    assert mean_inverse_distance(POINTS) == pytest.approx((1 / all_pairs(POINTS)[:, 0]).mean())
    assert mean_inverse_distance(POINTS * 4) == pytest.approx(mean_inverse_distance(POINTS) / 4)


def test_duplicates_change_nothing():
    again = np.concatenate([POINTS, POINTS[5:20], POINTS[5:9]])
    for distances in (neighbour_distance, mean_neighbour_distance):
        alone, among = distances(POINTS, 3), distances(again, 3)
        assert np.array_equal(among, np.concatenate([alone, alone[5:20], alone[5:9]]))
    assert mean_inverse_distance(again) == pytest.approx(mean_inverse_distance(POINTS), rel=1e-14)


@pytest.mark.filterwarnings("error")
def test_twins_that_differ_by_rounding_do_not_make_it_infinite():
    """As in a model merged with its like: the nearest point that is another counts."""
    twins = np.concatenate([POINTS, POINTS * (1 + 1e-12)])
    assert mean_inverse_distance(twins) == pytest.approx(mean_inverse_distance(POINTS))
    assert mean_inverse_distance(twins[:63]) == pytest.approx((1 / all_pairs(POINTS)[[*range(60), 0, 1, 2], 0]).mean())
    size = np.linalg.norm(np.ptp(POINTS, axis=0))
    least = mean_neighbour_distance(twins, 1).min()
    assert 0.99e-7 * size < least < 1.01e-7 * size


def test_too_few_points():
    pair = np.array([[0.0, 0, 0], [0, 3, 4], [0, 3, 4]])
    assert mean_neighbour_distance(pair, 2).tolist() == [5, 5, 5]
    assert neighbour_distance(pair).tolist() == [5, 5, 5]  # of as many as there are
    assert mean_inverse_distance(pair) == 0.2
    for distances in (lambda p: mean_neighbour_distance(p, 1), neighbour_distance, mean_inverse_distance):
        with pytest.raises(InputError, match="3 points all lie at one place"):
            distances(np.ones((3, 3)))


def test_another_sh_degree_keeps_the_bands_that_both_have():
    model = Gaussians.from_points(POINTS, np.zeros((60, 3), np.uint8), 2).located((1, 2, 3))
    model.rows["sh_rest"][:] = np.random.default_rng(0).normal(size=(60, 8, 3))
    more, fewer = model.with_sh_degree(3), model.with_sh_degree(1)
    assert np.array_equal(more.sh_rest[:, :8], model.sh_rest) and not more.sh_rest[:, 8:].any()
    assert np.array_equal(fewer.sh_rest, model.sh_rest[:, :3]) and fewer.sh_degree == 1
    assert more.sh_rest.shape == (60, 15, 3) and (more.offset == (1, 2, 3)).all()
    assert model.with_sh_degree(0).sh_rest.shape == (60, 0, 3)
