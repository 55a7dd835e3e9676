"""How a scene stands: which way is up, and along which lines its ground is best cut."""

import numpy as np

ANGLES = 90  # tried of a quarter turn
LEVEL = 3e-4  # the square of a degree: nothing is known to be more level than that
MOST = 200_000  # points looked at for them
MOSTLY = (0.002, 0.998)  # quantiles between which it lies: with fewer, corners are cut off


def up_axis(rotations, points):
    """float64[3], a unit vector: up, from cameras' rotations [V, 3, 3] and sparse points [N, 3].

    Two lines are asked, and the one that knows better answers: that most at right angles to the
    images' rows, as photographers hold the horizon level (Brown and Lowe 2007, section 5), and the
    normal of the plane along the points. Up is where the images' tops are, and where cameras look
    away from.
    """
    right = rotations[:, 0]
    lines = [_least(right.T @ right / len(right))]
    if len(points):
        lines.append(_least(_spread(points)))
    up = min(lines, key=lambda line: line[1])[0]
    tops = -rotations[:, 1].sum(axis=0) - rotations[:, 2].sum(axis=0)
    return up if up @ tops >= 0 else -up


def _least(matrix):
    """(the direction of least spread, its share of the next larger) of a float64[3, 3]."""
    values, vectors = np.linalg.eigh(matrix)
    least, next_larger, _ = values + LEVEL * values.sum()
    return vectors[:, 0], least / next_larger


def _spread(points):
    """Covariance float64[3, 3] of the nearer nine tenths of points [N, 3]."""
    away = points - np.median(points, axis=0)
    distance = (away**2).sum(axis=1)
    near = points[distance <= np.quantile(distance, 0.9)]
    near = near - near.mean(axis=0)
    return near.T @ near / len(near)


def ground_axes(up, content, weights):
    """float64[3, 3], rows u, v, up: right-handed, u along the content's longer side.

    u and v are the sides of the smallest rectangle that holds the content but for outliers, as
    streets and flight lines are; u points where the content has its longer tail. So they turn with
    the scene.
    """
    first = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    plane = np.stack([first, np.cross(up, first)]) / np.linalg.norm(first)
    content, weights = content[weights > 0], weights[weights > 0]
    some = content[::-(-len(content) // MOST)]
    along = (some - some.mean(axis=0)) @ plane.T
    principal = np.linalg.eigh(along.T @ along)[1][:, 1]
    turns = np.arctan2(principal[1], principal[0]) + np.arange(ANGLES) / ANGLES * np.pi / 2
    areas = [np.prod(np.ptp(np.quantile(along @ _turned(turn).T, MOSTLY, axis=0), axis=0))
             for turn in turns]
    axes = _turned(turns[np.argmin(areas)]) @ plane
    low, middle, high = np.transpose([quantiles(content @ axis, weights, (0.01, 0.5, 0.99))
                                      for axis in axes])
    longer = int(np.argmax(high - low))
    u = axes[longer] * (1 if high[longer] + low[longer] >= 2 * middle[longer] else -1)
    return np.stack([u, np.cross(up, u), up])


def _turned(angle):
    return np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])


def quantiles(values, weights, shares):
    """float64[K]: below which numbers these shares of the weight of values float64[N] lie."""
    order = np.argsort(values, kind="stable")
    weight = np.cumsum(weights[order])
    return np.interp(shares, (weight - weights[order] / 2) / weight[-1], values[order])
