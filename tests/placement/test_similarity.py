"""Similarity transforms."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clsplat.placement.similarity import fitted, rotation_to


def test_a_similarity_is_found_from_exact_points():
    rng = np.random.default_rng(0)
    points, turn = rng.normal(size=(5, 3)), Rotation.random(random_state=0).as_matrix()
    target = 7.0 * points @ turn.T + [5e5, 4e6, 300]
    found = fitted(points, target)
    assert found.scale == pytest.approx(7) and np.allclose(found.rotation, turn)
    assert np.allclose(found(points), target)


@pytest.mark.parametrize("points", [np.eye(3)[:2], np.zeros((4, 3)),
                                    np.outer(np.arange(4.0), [1, 2, 3])])
def test_points_on_a_line_determine_nothing(points):
    assert fitted(points, points) is None


@pytest.mark.parametrize("target", [(0, 0, 1), (0, 0, -1), (0.6, 0, 0.8), (-0.6, 0.8, 0)])
def test_a_direction_is_turned_into_another(target):
    rotation = rotation_to(np.array([0.0, 0, 1]), np.array(target, float))
    assert np.allclose(rotation[:, 2], target) and np.allclose(rotation @ rotation.T, np.eye(3))
    assert np.linalg.det(rotation) == pytest.approx(1)
