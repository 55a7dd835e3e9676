"""Gross errors of positions are refused, or their result is right or comes with a warning."""

from collections import Counter

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clsplat.placement.alignment import aligned
from clsplat.placement.plausible import Guess, NotGeoreferenced, believed, doubts
from clsplat.placement.up import Vertical
from tests.placement.mistakes import MISTAKES, outcome

SEEDS = 90  # of each of 17 mistakes: 1,530 alignments


@pytest.mark.parametrize(
    "seeds", [pytest.param(1, marks=pytest.mark.one_in(8)), pytest.param(SEEDS, marks=pytest.mark.nightly)]
)
@pytest.mark.parametrize("mistake", MISTAKES)
def test_no_mistake_is_believed(mistake, seeds):
    found = Counter((each.kind, each.right) for each in (outcome(mistake, seed) for seed in range(seeds)))
    print(f"{mistake}: {dict(found)}")
    assert not found["believed", False]
    if mistake == "none":
        assert not found["refused", False] and found["believed", True] >= seeds // 2


def grid(columns=6, rows=4, seed=0):
    """Camera centres of a nadir survey, metres, and their rotations."""
    x, y = np.meshgrid(np.arange(columns) * 20.0, np.arange(rows) * 26.0)
    centres = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 80.0)])
    centres += np.random.default_rng(seed).normal(0, 0.5, centres.shape)
    yaws = Rotation.from_rotvec(np.pi * np.outer(y.ravel() / 26 % 2, [0, 0, 1]))
    return centres, np.diag([1.0, -1.0, -1.0]) @ yaws.inv().as_matrix()


@pytest.mark.parametrize("noise", [0.0, 2.0])
@pytest.mark.parametrize("change", [lambda p: p[:, [1, 0, 2]], lambda p: p * (-1, 1, 1), lambda p: p * (1, -1, 1)])
@pytest.mark.one_in(3)
def test_mirrored_gps_of_a_flat_nadir_survey_is_refused(change, noise):
    centres, rotations = grid()
    ground = np.random.default_rng(1).uniform((0, 0, 0), (100, 80, 1), (200, 3))
    gps = centres + np.random.default_rng(2).normal(0, noise, centres.shape)
    vertical = Vertical.by_cameras(rotations, ground)
    assert believed(centres, gps, vertical).stands
    wrong = change(gps)
    assert not aligned(centres, wrong, vertical).stands  # with a residual as small
    refusal = "upside down or tilted by 1[78].* degrees: mirrored"
    with pytest.raises(NotGeoreferenced, match=refusal):
        believed(centres, wrong, vertical, [Guess("mirrored?", change(wrong))])


def test_few_photos_pass_with_a_warning():
    centres, rotations = grid(3, 1)
    centres[1, 1] += 15
    ground = np.random.default_rng(1).uniform((0, 0, 0), (100, 80, 1), (200, 3))
    vertical = Vertical.by_cameras(rotations, ground)
    gps = centres + np.random.default_rng(2).normal(0, 0.1, centres.shape)
    result = believed(centres, gps, vertical)
    found = doubts(result, gps, vertical, (result.horizontal, result.vertical))
    assert len(found) == 1 and found[0].startswith("only 3 positions decide")


def looking(directions):
    """Rotations of cameras with level rows."""
    right = np.cross(directions, [0, 0, 1])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    forward = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward], axis=1)


@pytest.mark.parametrize("steep", [-80, -45, 0, 20, 60])
def test_photos_in_any_direction_pass(steep):
    """Aerial oblique, along a facade, and of a tower from below."""
    rng = np.random.default_rng(0)
    angles = rng.uniform(-0.8, 0.8, 12)
    rise = np.tan(np.radians(steep + rng.normal(0, 3, 12)))
    rotations = looking(np.column_stack([np.sin(angles), np.cos(angles), rise]))
    centres = np.column_stack([np.linspace(0, 40, 12), rng.normal(0, 3, 12), rng.normal(2, 1, 12)])
    facade = rng.uniform((0, 20, 0), (40, 20.5, 15), (300, 3))
    turn = Rotation.random(random_state=1).as_matrix()
    vertical = Vertical.by_cameras(rotations @ turn.T, facade @ turn.T)
    found = believed(centres @ turn.T, centres + rng.normal(0, 0.2, centres.shape), vertical)
    assert found.stands
    assert np.degrees(Rotation.from_matrix(found.similarity.rotation @ turn).magnitude()) < 10


def test_a_gimbal_that_looks_up_is_believed():
    """Under a bridge: without a gimbal the photos look as if all were upside down."""
    centres, rotations = grid()
    over = Rotation.from_euler("x", 180, degrees=True).as_matrix()
    rotations = rotations @ over  # straight upwards
    bridge = np.random.default_rng(1).uniform((0, 0, 90), (100, 80, 91), (200, 3))
    assert not aligned(centres, centres, Vertical.by_cameras(rotations, bridge)).stands
    assert believed(centres, centres, Vertical.measured((0, 0, 1))).stands


@pytest.mark.parametrize("factor", [1e-12, 1e-5, 1e5, 1e12])
def test_any_unit_is_aligned(factor):
    centres, _ = grid()
    found = aligned(centres * factor, centres, Vertical.measured((0, 0, 1)))
    assert found.similarity.scale == pytest.approx(1 / factor, rel=1e-3)
