"""Which photos show the same places, from which directions and how near.

`adjacent_views` picks those that teach depth; `view_spread` tells how far the views of a point are
apart, which decides what a scene needs.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

BEST_ANGLE = 10.0  # degrees between two views' rays at a point
SPREAD = np.log(2)  # of the angle's logarithm: half and twice the best angle weigh exp(-1/2)
ANGLES = (1.0, 60.0)  # degrees: outside, a point does not count as shared
SHARED = 20  # points that two adjacent views share at least
PROJECTED = 10_000  # points projected where the scene has no observations


def adjacent_views(scene, views, count=3):
    """For each view the other views that best compare with it: a list of int[<= count], best first.

    scene: Scene; views: tuple of its Views, such as one part of `scene.split`; the result counts
    them in this order. Two views are compared by the points both see: a point adds
    exp(-(ln(angle / 10 deg) / ln 2)^2 / 2), the angle being the one at the point between the two
    cameras. So 5 to 20 degrees weigh 0.6 or more; small angles teach no depth, large ones share no
    appearance (Yao et al. 2018, MVSNet, section 4.1, rank by angle too). Views that share fewer
    than 20 points at 1 to 60 degrees are not adjacent; a view may have none.

    Where `scene.observations` is None, a view sees each of at most 10000 evenly picked points that
    project into its image, hidden or not.
    """
    points, point, view = sightings(scene, views)
    sees = csr_array((np.ones(len(view), np.int8), (view, point)), (len(views), len(points)))
    seen_by = csr_array(sees.T)
    positions = np.array([v.camera.position for v in views]).reshape(-1, 3)
    return [_best(number, sees, seen_by, points, positions, count) for number in range(len(views))]


@dataclass(frozen=True, eq=False)
class Spread:
    """Of each of K points that two views or more see: cap float64[K], degrees, the largest angle
    between the direction to a camera and the mean of these directions; ratio float64[K], the
    largest over the smallest size of a pixel at the point (depth / focal length)."""

    cap: np.ndarray
    ratio: np.ndarray


def view_spread(scene, views):
    """The Spread of the sparse points of a Scene over its `views`, as `adjacent_views` counts who
    sees what: by the tracks, else by projection, hidden or not."""
    points, point, view = sightings(scene, views)
    cameras = [v.camera for v in views]
    positions, forward = (np.array(values).reshape(-1, 3) for values in (
        [c.position for c in cameras], [c.rotation[2] for c in cameras]))
    ray = positions[view] - points[point]
    direction = ray / np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-300)
    middle = np.zeros((len(points), 3))
    np.add.at(middle, point, direction)
    middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-300)
    # by the chord: an arc cosine knows small angles only to 1e-6 degrees
    chord = np.linalg.norm(direction - middle[point], axis=1)
    angle = np.rad2deg(2 * np.arcsin((chord / 2).clip(0, 1)))
    depth = -(ray * forward[view]).sum(axis=1)
    focal = np.array([np.mean(c.focal) for c in cameras])
    with np.errstate(invalid="ignore", divide="ignore"):
        size = np.log(depth / focal[view])
    cap, low, high = (np.full(len(points), start) for start in (0.0, np.inf, -np.inf))
    np.maximum.at(cap, point, angle)
    np.minimum.at(low, point, size)
    np.maximum.at(high, point, size)
    several = np.bincount(point, minlength=len(points)) >= 2
    return Spread(cap[several], np.exp((high - low)[several]))


def sightings(scene, views):
    """(points float64[P, 3], point int[M], view int[M]): which of `views` sees which point."""
    if scene.observations is None:
        return _projected(scene.points, views)
    return scene.points, *_observed(scene, views)


def _observed(scene, views):
    """(point int[M], view int[M]) of the observations in `views`, views counted in that order."""
    numbers = {view.name: number for number, view in enumerate(views)}
    place = np.array([numbers.get(view.name, -1) for view in scene.views])
    point, view = scene.observations[:, 0], place[scene.observations[:, 1]]
    return point[view >= 0], view[view >= 0]


def _projected(points, views):
    """(points float64[P, 3], point int[M], view int[M]): some points and the images they fall in.
    """
    points = points[::-(-len(points) // PROJECTED)]
    inside = [np.flatnonzero(view.sees(points)) for view in views]
    lengths = [len(point) for point in inside]
    return points, np.concatenate([[], *inside]).astype(int), np.repeat(range(len(views)), lengths)


def _best(number, sees, seen_by, points, positions, count):
    """int[<= count]: the views adjacent to one, best first, equals by their number."""
    own = sees.indices[sees.indptr[number]:sees.indptr[number + 1]]
    shared = seen_by[own]  # a row a point: the views that see it
    other, point = shared.indices, np.repeat(own, np.diff(shared.indptr))
    angle = _angle(points[point], positions[number], positions[other])
    useful = (angle >= ANGLES[0]) & (angle <= ANGLES[1])  # the view itself is at no angle
    other, angle = other[useful], angle[useful]
    weight = np.exp(-0.5 * (np.log(angle / BEST_ANGLE) / SPREAD) ** 2)
    score = np.bincount(other, weight, len(positions))
    enough = np.bincount(other, minlength=len(positions)) >= SHARED
    order = np.argsort(-score, kind="stable")
    return order[enough[order]][:count]


def _angle(points, a, b):
    """Degrees float64[M] at points [M, 3] between the directions to a and b; nan at a or b."""
    a, b = a - points, b - points
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = (a * b).sum(axis=1) / np.sqrt((a * a).sum(axis=1) * (b * b).sum(axis=1))
    return np.rad2deg(np.arccos(cosine.clip(-1, 1)))
