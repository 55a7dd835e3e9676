"""Where a point that was marked in photos lies in a reconstruction."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LEAST_ANGLE = np.radians(1.0)  # between rays; from closer ones the distance is not known


def intersection(origins: NDArray[np.float64], directions: NDArray[np.float64],
                 tolerance: float) -> tuple[NDArray[np.float64], NDArray[np.bool_]] | None:
    """The point nearest to most of several rays.

    Parameters
    ----------
    origins : [K, 3]; camera centres.
    directions : [K, 3]; unit vectors.
    tolerance : radians, by which a ray may miss the point; rays that miss it by more are left out,
        the worst first, while at least three are left.

    Returns
    -------
    The point [3], and which rays it comes from as bool[K]; None if there are not two rays from
    sufficiently different directions, or the point is behind a camera.
    """
    used: NDArray[np.bool_] = np.all(np.isfinite(directions), axis=1)
    while used.sum() >= 2:
        projectors = np.eye(3) - directions[used, :, None] * directions[used, None, :]
        matrix = projectors.sum(axis=0)
        # for two rays with an angle a between them, the least eigenvalue is 1 - cos a
        if np.linalg.eigvalsh(matrix)[0] < 1 - np.cos(LEAST_ANGLE):
            return None
        point: NDArray[np.float64] = np.linalg.solve(
            matrix, np.einsum("kij,kj->i", projectors, origins[used]))
        misses = miss_angles(point, origins, directions)
        worst = int(np.argmax(np.where(used, misses, -1.0)))
        if misses[worst] <= tolerance or used.sum() == 2:
            return (point, used) if misses[used].max() < np.pi / 2 else None
        used[worst] = False
    return None


def miss_angles(point: NDArray[np.float64], origins: NDArray[np.float64],
                directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """The angles [K], radians, between rays and the directions to a point."""
    towards = point - origins
    along = (towards * directions).sum(axis=1)
    across = np.linalg.norm(np.cross(towards, directions), axis=1)
    angles: NDArray[np.float64] = np.arctan2(across, along)
    return angles
