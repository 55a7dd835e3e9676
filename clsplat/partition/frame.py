"""The axes along which the ground of a scene is best cut."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

ANGLE_STEPS = 90  # rectangles that are tried over a quarter turn
MOST_SAMPLED = 50_000  # content points that the rectangles are tried on
RECTANGLE_QUANTILES = (0.002, 0.998)  # inside the rectangle; with fewer, corners would be cut off


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
