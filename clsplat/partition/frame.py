"""The orientation of a scene: which way is up, and along which axes its ground is best cut."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

ANGLE_STEPS = 90  # rectangles that are tried over a quarter turn
LEVEL_NOISE = 3e-4  # square of a degree in radians: nothing is known to be more level than that
MOST_SAMPLED = 200_000  # content points that the rectangles are tried on
RECTANGLE_QUANTILES = (0.002, 0.998)  # inside the rectangle; with fewer, corners would be cut off


def up_axis(rotations: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Estimate the unit vector [3] that points up.

    There are two candidates: the direction most perpendicular to the rows of the images, since
    photographers keep the horizon level (Brown and Lowe 2007, section 5), and the normal of the
    plane through the points. The better determined one is taken. Its sign follows the tops of the
    images, and the direction away from which the cameras look.

    Parameters
    ----------
    rotations : [V, 3, 3], world to camera.
    points : [N, 3], world; sparse points.
    """
    right = rotations[:, 0]
    candidates = [_least_spread(right.T @ right / len(right))]
    if len(points):
        candidates.append(_least_spread(_covariance(points)))
    up = min(candidates, key=lambda candidate: candidate[1])[0]
    tops = -rotations[:, 1].sum(axis=0) - rotations[:, 2].sum(axis=0)
    return up if up @ tops >= 0 else -up


def _least_spread(matrix: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """The eigenvector of the smallest eigenvalue of [3, 3], and its ratio to the next larger one.
    """
    values, vectors = np.linalg.eigh(matrix)
    least, next_larger, _ = values + LEVEL_NOISE * values.sum()
    return vectors[:, 0], least / next_larger


def _covariance(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Covariance [3, 3] of the nine tenths of the points that are nearest to their median."""
    away = points - np.median(points, axis=0)
    distance = (away**2).sum(axis=1)
    near = points[distance <= np.quantile(distance, 0.9)]
    near = near - near.mean(axis=0)
    covariance: NDArray[np.float64] = near.T @ near / len(near)
    return covariance


def ground_axes(up: NDArray[np.float64], content: NDArray[np.float64],
                weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """The axes u, v and up as rows [3, 3], right-handed, with u along the content's longer side.

    u and v are the sides of the smallest rectangle around the content without outliers, which
    follows streets and flight lines; u points to the side where the content has its longer tail.
    The axes therefore rotate with the scene.

    Parameters
    ----------
    up : [3], a unit vector.
    content : [M, 3], world.
    weights : [M]; content of weight 0 is ignored.
    """
    first = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    plane = np.stack([first, np.cross(up, first)]) / np.linalg.norm(first)
    content, weights = content[weights > 0], weights[weights > 0]
    sampled = content[::-(-len(content) // MOST_SAMPLED)]
    along = (sampled - sampled.mean(axis=0)) @ plane.T
    principal = np.linalg.eigh(along.T @ along)[1][:, 1]
    angles = (np.arctan2(principal[1], principal[0])
              + np.arange(ANGLE_STEPS) / ANGLE_STEPS * np.pi / 2)
    areas = [np.prod(np.ptp(np.quantile(along @ _rotation(angle).T, RECTANGLE_QUANTILES, axis=0),
                            axis=0)) for angle in angles]
    axes = _rotation(angles[np.argmin(areas)]) @ plane
    low, middle, high = np.transpose([quantiles(content @ axis, weights, (0.01, 0.5, 0.99))
                                      for axis in axes])
    longer = int(np.argmax(high - low))
    u = axes[longer] * (1 if high[longer] + low[longer] >= 2 * middle[longer] else -1)
    return np.stack([u, np.cross(up, u), up])


def _rotation(angle: float) -> NDArray[np.float64]:
    return np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])


def quantiles(values: NDArray[np.float64], weights: NDArray[np.float64], shares: Sequence[float]
              ) -> NDArray[np.float64]:
    """Weighted quantiles [K]: the numbers below which `shares` [K] of the weight of `values` lie.
    """
    order = np.argsort(values, kind="stable")
    weight = np.cumsum(weights[order])
    return np.interp(shares, (weight - weights[order] / 2) / weight[-1], values[order])
