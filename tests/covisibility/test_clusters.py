"""Clusters of points: a view is compared with all that it shows, and with few others."""

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.covisibility.clusters import CLUSTER, Clusters


def cameras(count, seed=0):
    """Above a plain of 100 x 100 x 5, some within it, looking to all sides."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        position = rng.uniform((0, 0, 1), (100, 100, 30))
        yield Camera.looking_at(
            position + rng.normal(size=3), position, width=64, height=40, degrees=rng.uniform(20, 100)
        )


def strewn(count, seed=0):
    return np.random.default_rng(seed).uniform((0, 0, 0), (100, 100, 5), (count, 3))


def shown(positions, camera, near, beside=0.0):
    """bool[N]: what a view shows."""
    pixels, depths = camera.project(positions)
    return (depths > near) & camera.contains(pixels, beside)


@pytest.mark.parametrize("count", [0, 1, 2, CLUSTER, CLUSTER + 1, 40 * CLUSTER + 7])
def test_no_view_misses_a_point(count):
    positions = strewn(count)
    clusters = Clusters(positions)
    assert np.array_equal(np.sort(clusters.order), np.arange(count))
    for camera in cameras(30):
        for near, beside in ((0.01, 0), (5.0, 0), (0.01, 7)):
            expected = shown(positions, camera, near, beside)
            near_view = np.zeros(count, bool)
            near_view[clusters.order[clusters.near_view(camera, near, beside)]] = True
            assert not (expected & ~near_view).any()


def test_a_view_is_compared_with_few():
    positions = strewn(100 * CLUSTER)
    clusters = Clusters(positions)
    for camera in cameras(10):
        below = camera.position * (1, 1, 0)
        camera = Camera.looking_at(below, below + (0.1, 0.1, 20), width=64, height=40)
        assert len(clusters.near_view(camera, 0.01)) < 0.25 * len(positions)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_points_that_are_not_finite_hide_no_others(value):
    positions = strewn(4 * CLUSTER)
    positions[::50, 0] = value
    clusters = Clusters(positions)
    for camera in cameras(10):
        with np.errstate(invalid="ignore"):
            expected = shown(positions, camera, 0.01)
        near_view = np.zeros(len(positions), bool)
        near_view[clusters.order[clusters.near_view(camera, 0.01)]] = True
        assert not (expected & ~near_view).any()
