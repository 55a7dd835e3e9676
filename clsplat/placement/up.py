"""Which way is up in a scene, by its cameras and points, or by the gimbals of its cameras."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LEVEL_NOISE = 3e-4  # square of a degree in radians: nothing is known to be more level than that
ITERATIONS = 20
MOST_SAMPLED = 20_000  # points
GIMBAL_SPREAD = 5.0  # degrees, median; gimbals that differ by more say nothing


def up_axis(rotations: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Estimate the unit vector [3] that points up.

    There are two candidates: the direction most perpendicular to the rows of the images, since
    photographers keep the horizon level (Brown and Lowe 2007, section 5), and the normal of the
    plane through the points. The better determined one is taken. Its sign follows the tops of the
    images, and the direction away from which the cameras look. A minority of turned photos, or of
    points on buildings and trees, has little influence.

    Parameters
    ----------
    rotations : [V, 3, 3], world to camera.
    points : [N, 3], world; sparse points.
    """
    candidates = [_least_spread(rotations[:, 0])]
    if len(points):
        candidates.append(_least_spread(_centred(points)))
    up = min(candidates, key=lambda candidate: candidate[1])[0]
    tops = -rotations[:, 1].sum(axis=0) - rotations[:, 2].sum(axis=0)
    return up if up @ tops >= 0 else -up


def gimbal_up(rotations: NDArray[np.float64], pitches: NDArray[np.float64],
              rolls: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """The unit vector [3] that points up by the angles of gimbals, which measure gravity.

    Parameters
    ----------
    rotations : [V, 3, 3], world to camera.
    pitches : [V], degrees; -90 if the camera looks straight down.
    rolls : [V], degrees, clockwise.

    Returns
    -------
    None if the gimbals contradict each other.
    """
    pitch, roll = np.radians(pitches), np.radians(rolls)
    in_camera = np.stack([-np.cos(pitch) * np.sin(roll), -np.cos(pitch) * np.cos(roll),
                          np.sin(pitch)], axis=1)
    ups = np.einsum("vij,vi->vj", rotations, in_camera)
    up = np.median(ups, axis=0)
    length = float(np.linalg.norm(up))
    if not length > 0:
        return None
    up /= length
    angles = np.degrees(np.arccos(np.clip(ups @ up, -1, 1)))
    return up if np.median(angles) <= GIMBAL_SPREAD else None


def _least_spread(vectors: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """The direction [3] along which vectors [N, 3] have the least sum of lengths (least squares,
    reweighted), and the ratio of the spread along it to that along the next one."""
    weights = np.ones(len(vectors))
    noise = LEVEL_NOISE * float((vectors**2).sum(axis=1).mean())
    for _ in range(ITERATIONS):
        values, axes = np.linalg.eigh((vectors * weights[:, None]).T @ vectors / weights.sum())
        weights = 1 / np.sqrt((vectors @ axes[:, 0])**2 + noise)
    least, next_larger, _ = values + LEVEL_NOISE * values.sum()
    return axes[:, 0], float(least / next_larger)


def _centred(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Nine tenths of the points, those nearest to their median, from their mean."""
    sampled = points[::-(-len(points) // MOST_SAMPLED)]
    away = sampled - np.median(sampled, axis=0)
    distance = (away**2).sum(axis=1)
    near = away[distance <= np.quantile(distance, 0.9)]
    centred: NDArray[np.float64] = near - near.mean(axis=0)
    return centred
