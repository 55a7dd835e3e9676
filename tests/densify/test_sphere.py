"""The sphere around each anchor: its initial size, and what is outside."""

import numpy as np
import pytest

from clsplat.densify.sphere import outside, with_spheres
from clsplat.gaussians import SPHERE, Gaussians


def cloud(count, seed=0):
    rng = np.random.default_rng(seed)
    return Gaussians.from_points(rng.normal(size=(count, 3)), np.zeros((count, 3), np.uint8), sh_degree=1)


@pytest.mark.parametrize("neighbours", [1, 3, 15])
def test_spheres_at_the_start(neighbours):
    initial = cloud(40)
    gaussians = with_spheres(initial, neighbours)
    p = initial.positions.astype(float)
    apart = np.sort(np.linalg.norm(p[:, None] - p, axis=2), axis=1)[:, 1:]
    assert np.allclose(gaussians.max_offsets, apart[:, :neighbours].mean(axis=1), rtol=1e-6)
    assert np.array_equal(gaussians.anchors, initial.positions)
    assert gaussians.anchors is not initial.positions  # training moves one, not the other
    assert gaussians.sh_degree == 1
    for field in SPHERE:
        values = gaussians.rows[field.name]
        assert values.dtype == np.float32 and values.shape == (40, *field.shape)
    assert gaussians.rows.keys() == initial.rows.keys() | {"anchors", "max_offsets"}
    assert all(gaussians.rows[name] is values for name, values in initial.rows.items())
    assert not outside(gaussians.positions, gaussians.anchors, gaussians.max_offsets, 0.0).any()


def test_beyond_reach_times_max_offset_is_outside():
    """On it is not; distance is Euclidean."""
    anchors = np.float32([[1, 2, 3]] * 6)
    moved = np.float32([[3, 0, 4], [3, 0, 4], [0, 0, 0], [-5, 0, 0], [0, 5.0001, 0], [2.9] * 3])
    offsets = np.float32([2.5, 2.4999, 0, 2.5, 2.5, 2.5])
    assert outside(anchors + moved, anchors, offsets, 2.0).tolist() == [False, True, False, False, True, True]
    assert outside(anchors + moved, anchors, offsets, 3.0).tolist() == [False] * 6
    assert outside(anchors + moved, anchors, offsets, 0.0).tolist() == [True, True, False, True, True, True]
    assert outside(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), 2.0).shape == (0,)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["positions", "anchors", "max_offsets"])
def test_what_is_no_number_is_outside(name, value):
    rows = {
        "positions": np.zeros((3, 3), np.float32),
        "anchors": np.zeros((3, 3), np.float32),
        "max_offsets": np.ones(3, np.float32),
    }
    rows[name][1] = value
    # nothing is outside an infinite sphere
    expected = [False, not (name == "max_offsets" and value == np.inf), False]
    assert outside(*rows.values(), 15.0).tolist() == expected


@pytest.mark.parametrize("scale", [1.0, 1e-22, 1e18])
def test_close_to_the_border_double_precision_decides(scale):
    """Single precision rounds distances there, and squares of the smallest and largest away."""
    rng = np.random.default_rng(0)
    anchors = (scale * rng.normal(size=(20_000, 3))).astype(np.float32)
    away = rng.normal(size=anchors.shape)
    positions = (anchors + scale * away).astype(np.float32)
    distance = np.linalg.norm(positions.astype(np.float64) - anchors, axis=1)
    offsets = (distance / 15 * (1 + 1e-7 * rng.normal(size=len(distance)))).astype(np.float32)
    beyond = distance > 15 * offsets.astype(np.float64)
    assert 0.3 < beyond.mean() < 0.7
    assert np.array_equal(outside(positions, anchors, offsets, 15.0), beyond)
