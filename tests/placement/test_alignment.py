"""Alignment of a reconstruction with positions, of which some or all heights are wrong."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clsplat.placement.alignment import _Problem, aligned, fitted
from clsplat.placement.up import Vertical

SCALE = 14.0  # metres in a unit of the reconstruction


class Flight:
    """36 photos in six strips of 100 m, and the places of their cameras in a reconstruction whose
    direction up is known to 3 degrees."""

    def __init__(self, seed, noise=1.5):
        self.rng = rng = np.random.default_rng(seed)
        strips = [[(x, 20.0 * strip, 60.0) for x in np.linspace(0, 100, 6)[:: (-1) ** strip]] for strip in range(6)]
        self.true = np.concatenate(strips) + rng.normal(0, 1, (36, 3))
        self.turn = Rotation.random(random_state=seed).as_matrix()
        self.places = self.true @ self.turn.T / SCALE + rng.normal(size=3)
        wrong = Rotation.from_rotvec(np.radians(3) * np.array([0.6, 0.8, 0])).as_matrix()
        self.up = Vertical.measured(self.turn @ wrong[:, 2], 3.0)
        self.gps = self.true + rng.normal(0, noise, self.true.shape)

    def errors(self, result):
        """(relative error of the scale, tilt in degrees)."""
        up = result.similarity.rotation @ self.turn[:, 2]
        return (abs(result.similarity.scale / SCALE - 1), np.degrees(np.arccos(np.clip(up[2], -1, 1))))


@pytest.fixture(params=range(2))
def flight(request):
    return Flight(request.param)


def test_heights_level_the_scene_better_than_the_cameras(flight):
    result = aligned(flight.places, flight.gps, flight.up)
    scale, tilt = flight.errors(result)
    assert result.used.all()
    assert scale < 0.02 and tilt < 1.3
    assert 1 < result.horizontal < 3 and 0.7 < result.vertical < 2.5


def test_without_heights_the_cameras_level_the_scene(flight):
    flight.gps[:, 2] = np.nan
    result = aligned(flight.places, flight.gps, flight.up)
    scale, tilt = flight.errors(result)
    assert np.isnan(result.vertical)
    assert scale < 0.02 and tilt == pytest.approx(3, abs=0.1)


def test_grossly_wrong_positions_are_left_out(flight):
    wrong = flight.rng.choice(36, 8, replace=False)
    flight.gps[wrong] += flight.rng.normal(0, 300, (8, 3))
    result = aligned(flight.places, flight.gps, flight.up)
    scale, tilt = flight.errors(result)
    far = np.linalg.norm(flight.gps - flight.true, axis=1) > 30
    assert not result.used[far].any() and result.used[~far].mean() > 0.95
    assert scale < 0.03 and tilt < 2 and result.horizontal < 3


def test_a_wrong_up_is_not_taken_for_a_mirror_image(flight):
    """Positions that fit only upside down are either right, or mirrored: who calls decides."""
    assert not aligned(flight.places, flight.gps, Vertical.measured(-flight.up.up)).stands


def test_good_positions_count_more_than_bad_ones(flight):
    good = np.arange(36) % 3 == 0
    flight.gps[good] = flight.true[good] + flight.rng.normal(0, 0.02, (12, 3))
    std = np.where(good, 0.02, 1.5)[:, None].repeat(3, axis=1)
    result = aligned(flight.places, flight.gps, flight.up, std=std)
    plain = aligned(flight.places, flight.gps, flight.up)
    away = [np.abs(each.similarity(flight.places) - flight.true).max() for each in (result, plain)]
    assert away[0] < 0.15 < away[1]


@pytest.mark.parametrize(
    "positions", [np.zeros((2, 3)), np.zeros((36, 3)), np.random.default_rng(0).normal(0, 50, (36, 3))]
)
def test_positions_that_determine_nothing_align_nothing(positions):
    flight = Flight(0)
    assert aligned(flight.places[: len(positions)], positions, flight.up) is None


@pytest.mark.parametrize("seed", range(4))
def test_a_start_fits_those_that_are_right(seed):
    flight = Flight(seed, noise=0)
    wrong = flight.rng.permutation(36) < 9
    flight.gps[wrong] += flight.rng.normal(0, 300, (9, 3))
    problem = _Problem(flight.places, flight.gps, np.ones(36, bool), flight.up, np.ones((36, 3)), False)
    start = problem.free_start(np.random.default_rng(seed))
    assert np.allclose(start(flight.places)[~wrong], flight.gps[~wrong])


def test_a_similarity_is_fitted_where_points_determine_one():
    places = np.random.default_rng(0).normal(size=(5, 3))
    target = 2.5 * places @ Rotation.random(random_state=1).as_matrix().T + (1, 2, 3)
    assert np.allclose(fitted(places, target)(places), target)
    assert np.linalg.det(fitted(places, target * (-1, 1, 1)).rotation) == pytest.approx(1)
    for few in (np.outer([0, 1, 3], (1.0, 2, 3)), np.ones((4, 3)), places * np.nan):
        assert fitted(few, few) is None
