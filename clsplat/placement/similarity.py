"""Similarity transforms: a scale, a rotation and a translation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True, eq=False)
class Similarity:
    """x -> scale * rotation @ x + translation.

    Attributes
    ----------
    scale, rotation, translation : above 0, float64[3, 3], and float64[3] in target units.
    """

    scale: float
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]

    def __call__(self, points: ArrayLike) -> NDArray[np.float64]:
        """Transform points float[N, 3]."""
        return self.scale * np.asarray(points, np.float64) @ self.rotation.T + self.translation


def fitted(source: NDArray[np.float64], target: NDArray[np.float64]) -> Similarity | None:
    """The similarity with the least squared distances between points (Umeyama 1991).

    Parameters
    ----------
    source, target : [N, 3].

    Returns
    -------
    None if the points are too few, on a line or at one place, so that they determine none.
    """
    if len(source) < 3:
        return None
    from_middle, to_middle = source.mean(axis=0), target.mean(axis=0)
    centred = source - from_middle
    spread = float((centred**2).sum())
    left, values, right = np.linalg.svd((target - to_middle).T @ centred)
    if not values[1] > 1e-9 * values[0] or not spread > 0:
        return None
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))])
    rotation = (left * signs) @ right
    scale = float((values * signs).sum()) / spread
    return Similarity(scale, rotation, to_middle - scale * rotation @ from_middle
                      ) if scale > 0 else None


def rotation_to(direction: NDArray[np.float64], target: NDArray[np.float64]
                ) -> NDArray[np.float64]:
    """The smallest rotation [3, 3] that turns one unit vector into another."""
    cosine = float(direction @ target)
    if cosine < -1 + 1e-9:  # half a turn about any axis across
        axis = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
        axis /= np.linalg.norm(axis)
        return 2 * np.outer(axis, axis) - np.eye(3)
    matrix = cross_matrix(np.cross(direction, target))
    rotation: NDArray[np.float64] = np.eye(3) + matrix + matrix @ matrix / (1 + cosine)
    return rotation


def cross_matrix(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """The matrix [3, 3] whose product with any vector is the cross product with it."""
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
