"""Where marked points lie."""

import numpy as np
import pytest

from clsplat.io.georeference.adjustment import intersection

POINT = np.array([1.0, -2.0, 3.0])
ORIGINS = np.array([[0, 0, 50.0], [20, 0, 52], [-15, 18, 49], [5, -25, 51]])


def rays(noise=0.0):
    towards = POINT - ORIGINS + np.random.default_rng(0).normal(0, noise, ORIGINS.shape)
    return towards / np.linalg.norm(towards, axis=1, keepdims=True)


def test_rays_meet_in_their_point():
    point, used = intersection(ORIGINS, rays(), 0.01)
    assert np.allclose(point, POINT) and used.all()
    point, _ = intersection(ORIGINS, rays(0.05), 0.01)
    assert np.linalg.norm(point - POINT) < 0.3


def test_a_wrong_mark_is_left_out():
    directions = rays()
    directions[2] = rays(10.0)[0]
    point, used = intersection(ORIGINS, directions, 0.01)
    assert np.allclose(point, POINT) and used.tolist() == [True, True, False, True]


@pytest.mark.parametrize("change", [
    lambda directions: directions * np.nan, lambda directions: -directions,
    lambda directions: directions[:1].repeat(4, axis=0)])
def test_rays_without_an_intersection(change):
    assert intersection(ORIGINS, change(rays()), 0.01) is None
