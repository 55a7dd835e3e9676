"""Which views see the same points, from which directions and distances.

`choose_source_views` chooses for each reference view the source views that constrain its depth.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.scene import Scene, View, rows_by_view

if TYPE_CHECKING:
    from scipy.sparse import csr_array

BEST_ANGLE = 10.0  # degrees between two views' rays at a point
LOG_ANGLE_SIGMA = np.log(2)  # half and twice the best angle have the weight exp(-1/2)
ANGLE_RANGE = (1.0, 60.0)  # degrees: at other angles, a point does not count as shared
LEAST_SHARED = 20  # points that a source view shares with the reference view
MOST_PROJECTED = 10_000  # points that are projected where the scene has no observations


def choose_source_views(scene: Scene, views: Sequence[View], count: int = 3) -> list[NDArray[np.integer]]:
    """Choose for each view, as the reference view, the best `count` source views among the others.

    A source view's score is the sum, over the points that both views see, of
    exp(-(ln(angle / 10 deg) / ln 2)^2 / 2), with the angle at the point between the two cameras.
    Angles of 5 to 20 degrees therefore have a weight of at least 0.6. Small angles do not constrain
    depth, and from large angles a surface looks different (Yao et al. 2018, MVSNet, section 4.1,
    rank views by angle too). Views that share fewer than 20 points at 1 to 60 degrees are not
    source views.

    Returns for each of `views`, such as one part of `scene.split`, int[<= count], indices into
    `views`, best first; it may be empty."""
    points, point, view = visibility(scene, views)
    sees = scipy.sparse.csr_array((np.ones(len(view), np.int8), (view, point)), (len(views), len(points)))
    seen_by = scipy.sparse.csr_array(sees.T)
    positions = np.array([v.camera.position for v in views]).reshape(-1, 3)
    with ThreadPoolExecutor() as pool:
        return list(pool.map(lambda number: _best(number, sees, seen_by, points, positions, count), range(len(views))))


def visibility(
    scene: Scene, views: Sequence[View]
) -> tuple[NDArray[np.float64], NDArray[np.integer], NDArray[np.integer]]:
    """The points [P, 3], and the pairs of a point [M] and an index into `views` [M] that see it.

    Where the scene has no observations, a view sees those of at most 10000 evenly chosen points
    that project into its image, without an occlusion test."""
    if scene.observations is not None:
        return scene.points, *_observed(scene.observations, scene.views, views)
    points = scene.points[:: max(1, -(-len(scene.points) // MOST_PROJECTED))]
    inside = [np.flatnonzero(view.sees(points)) for view in views]
    lengths = [len(point) for point in inside]
    return points, np.concatenate([[], *inside]).astype(int), np.repeat(range(len(views)), lengths)


def _observed(
    observations: NDArray[np.integer], all_views: Sequence[View], views: Sequence[View]
) -> tuple[NDArray[np.integer], NDArray[np.integer]]:
    """Points [M] and indices into `views` [M] of the scene's observations in these views."""
    numbers = {view.name: number for number, view in enumerate(views)}
    place = np.array([numbers.get(view.name, -1) for view in all_views])
    point, view = observations[:, 0], place[observations[:, 1]]
    return point[view >= 0], view[view >= 0]


def observed_points(scene: Scene, views: Sequence[View]) -> list[NDArray[np.integer]]:
    """For each of `views` the sparse points that it sees; none where the scene has no observations."""
    if scene.observations is None:
        return [np.zeros(0, int) for _ in views]
    return by_view(*_observed(scene.observations, scene.views, views), len(views))


def by_view(point: NDArray[np.integer], view: NDArray[np.integer], views: int) -> list[NDArray[np.integer]]:
    """The points that each of so many views sees, from pairs of a point and a view, in their order."""
    return [point[rows] for rows in rows_by_view(view, views)]


def photos_of_a_point(scene: Scene, views: Sequence[View]) -> float:
    """The mean number of `views` that show a sparse point, of those that two or more show; nan
    where that is not known."""
    known = scene.observations
    times = np.bincount([] if known is None else _observed(known, scene.views, views)[0])
    several = times[times >= 2]
    return float(several.mean()) if len(several) else float("nan")


def _best(
    number: int,
    sees: csr_array,
    seen_by: csr_array,
    points: NDArray[np.float64],
    positions: NDArray[np.float64],
    count: int,
) -> NDArray[np.integer]:
    """The source views of one view, int[<= count], best first, equally good ones by index."""
    own = sees.indices[sees.indptr[number] : sees.indptr[number + 1]]
    shared = seen_by[own]  # each row has the views that see a point
    other, point = shared.indices, np.repeat(own, np.diff(shared.indptr))
    angle = _angle(points[point], positions[number], positions[other])
    useful = (angle >= ANGLE_RANGE[0]) & (angle <= ANGLE_RANGE[1])  # the view itself has angle 0
    other, angle = other[useful], angle[useful]
    weight = np.exp(-0.5 * (np.log(angle / BEST_ANGLE) / LOG_ANGLE_SIGMA) ** 2)
    score = np.bincount(other, weight, len(positions))
    enough = np.bincount(other, minlength=len(positions)) >= LEAST_SHARED
    order = np.argsort(-score, kind="stable")
    return order[enough[order]][:count]


def _angle(points: NDArray[np.float64], a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """The angle [M] at points [M, 3] between the directions to a and b, degrees; nan at a or b."""
    a, b = a - points, b - points
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = (a * b).sum(axis=1) / np.sqrt((a * a).sum(axis=1) * (b * b).sum(axis=1))
    angle: NDArray[np.float64] = np.rad2deg(np.arccos(cosine.clip(-1, 1)))
    return angle
