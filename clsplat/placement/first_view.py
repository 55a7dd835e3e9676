"""From where a viewer should first look at a scene."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera

WIDTH, HEIGHT, DEGREES = 1280, 720, 50.0  # of a view from above
STEEP = -0.35  # cameras that look downwards more than this (20 degrees) are above their scene
CORE = 0.95  # share of the points that a view from above shows whole
LEAST_EXTENT = 1e-6  # of the distance from the origin; points that are closer together are one
# degrees above the horizon of a view from above: as steep as the photos, within these limits
ELEVATIONS = (35.0, 60.0)


def first_view(
    cameras: Sequence[Camera],
    points: NDArray[np.float64],
    up: NDArray[np.float64],
    north: NDArray[np.float64] | None = None,
) -> Camera:
    """The camera from which a viewer should first look.

    If the cameras stand above the scene and look down, it is a view of the whole from obliquely
    above, where photos of it were taken from similar directions; otherwise it is the camera of a
    photo in the middle, since the scene may look bad from where no photo was taken.

    Parameters
    ----------
    cameras : of the photos, at least one.
    points : [N, 3], world; the sparse points.
    up : [3], world; a unit vector.
    north : [3], world; a horizontal unit vector that is upwards on a map. None: unknown.
    """
    steepness = float(np.median([camera.rotation[2] @ up for camera in cameras]))
    positions = np.array([camera.position for camera in cameras])
    if steepness < STEEP and len(points) and (np.median(positions @ up) > np.quantile(points @ up, 0.8)):
        if north is None:
            north = _towards(cameras, _near(points), up)
        distances = np.linalg.norm(positions - np.median(points, axis=0), axis=1)
        return view_from_above(points, up, north, steepness, float(np.median(distances)))
    # the camera that shows most points, among the half nearest to the middle of all
    away = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    near = np.argsort(away, kind="stable")[: (len(cameras) + 1) // 2]
    return cameras[max(near.tolist(), key=lambda index: int(cameras[index].shows(points).sum()))]


def _near(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The points without those that are farthest from the median."""
    distances = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    near: NDArray[np.float64] = points[distances <= np.quantile(distances, CORE)]
    return near


def view_from_above(
    points: NDArray[np.float64],
    up: NDArray[np.float64],
    north: NDArray[np.float64],
    steepness: float,
    if_one: float = 1.0,
) -> Camera:
    """A camera obliquely above that shows the core of the points.

    Parameters
    ----------
    points : [N, 3], world, at least one.
    up, north : [3], world; orthogonal unit vectors.
    steepness : sine of the elevation of the photos, negative if they look down.
    if_one : distance of the camera if all points are one.
    """
    middle, near = np.median(points, axis=0), _near(points)
    elevation = np.radians(np.clip(np.degrees(np.arcsin(-steepness)), *ELEVATIONS))
    forward = np.cos(elevation) * north - np.sin(elevation) * up

    def at(distance: float) -> Camera:
        return Camera.looking_at(
            middle, middle - distance * forward, up=up, width=WIDTH, height=HEIGHT, degrees=DEGREES
        )

    # the distance at which the core fits: a point at (x, y, z) of the camera's axes is within the
    # image if |x| <= tan (z + distance), and so for y
    view = at(1.0)
    right, down, ahead = view.rotation @ (near - middle).T
    tangents = view.width / 2 / view.focal[0], view.height / 2 / view.focal[1]
    reach = np.maximum(np.abs(right) / tangents[0], np.abs(down) / tangents[1]) - ahead
    distance = float(np.quantile(reach, CORE))
    return at(distance if distance > LEAST_EXTENT * float(np.linalg.norm(middle)) else if_one)


def _towards(cameras: Sequence[Camera], points: NDArray[np.float64], up: NDArray[np.float64]) -> NDArray[np.float64]:
    """The horizontal direction, across the longer side of the points, in which most photos look, or
    else which is upwards in most of them."""
    first = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    plane = np.stack([first, np.cross(up, first)]) / np.linalg.norm(first)
    along = (points - points.mean(axis=0)) @ plane.T
    shorter: NDArray[np.float64] = np.linalg.eigh(along.T @ along)[1][:, 0] @ plane
    looks = sum(camera.rotation[2] - 0.1 * camera.rotation[1] for camera in cameras)
    return shorter if shorter @ looks >= 0 else -shorter
