"""The paths of a film's camera: over the site, along the photos, around the scene, or as given."""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.polynomial import Polynomial
from numpy.typing import ArrayLike, NDArray

from clsplat.apps.orthophoto import LEAST_VIEWS, shown_by
from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.io.fields import LARGEST_COORDINATE, number, reading
from clsplat.io.records import object_of
from clsplat.io.regular import read_regular
from clsplat.io.scenes.posed import FLIPPED
from clsplat.partition.region import ground_axes, map_axes, world_of
from clsplat.scene import Scene

# a film looks from where photos were taken, so the angle of view is at most theirs, and at least
# and at most this, degrees
DEGREES = (40.0, 75.0)
KEYS_A_SECOND = 1.0  # photos that a flight passes, at most: more would shake
SMOOTHING = 1.0  # keys, the standard deviation of the filter along a flight
ELEVATIONS = (20.0, 55.0)  # degrees above the horizon of a turntable's camera
TURNING = 1.0  # seconds, the standard deviation of the filter of turns
KEYS_OF_A_PATH, PATH_KEYS = 30, (64, 2000)  # a second; least and most
FINER = 8  # places of a curve for each key
LEAST_STEP = 1e-9  # of a path's time, and of its coordinates, between two keys
# of the film over a survey whose photos look down
LOOKS_DOWN = 45.0  # degrees from the vertical, median of the photos
ELEVATION = 45.0  # degrees below the horizon, to which the film looks
OBLIQUE_DEGREES = 50.0  # horizontal angle of view: a wider one would show more than the photos
UPPER = 17.0  # degrees above the middle of the picture, which must still show covered ground
TURN = 6.0  # degrees a second around the middle of the site
LONG = 2.5  # a site so many times as long as wide is flown along
CORE = (0.05, 0.95)  # quantiles of the covered places that bound the site
DISTANCES = (0.5, 1.3)  # from where the film looks, least and most, in heights of the flight
MIDDLE_DEGREE = 3  # of the polynomial along the middle of a long site


@dataclass(frozen=True, eq=False)
class Keys:
    """Poses through which a camera flies.

    Attributes
    ----------
    times : float64[K], K > 1, from 0 to 1, ascending: shares of the film at which each is reached.
    positions : float64[K, 3], in original coordinates.
    rotations : float64[K, 3, 3], from the world to the camera.
    degrees : float64[K] or a number, horizontal angle of view; nan: that of the film.
    """

    times: NDArray[np.float64]
    positions: NDArray[np.float64]
    rotations: NDArray[np.float64]
    degrees: ArrayLike = math.nan


def interpolated(keys: Keys, times: NDArray[np.float64], size: tuple[int, int], degrees: float) -> list[Camera]:
    """The cameras of a film at times within [0, 1].

    Positions follow cubic curves that do not overshoot; rotations have continuous angular
    acceleration.

    Parameters
    ----------
    keys : of the path.
    times : float64[N], shares of the film.
    size : (width, height) of the film, pixels.
    degrees : horizontal angle of view, where the keys have none.
    """
    positions = scipy.interpolate.PchipInterpolator(keys.times, keys.positions)(times)
    turns = scipy.spatial.transform.RotationSpline(
        keys.times, scipy.spatial.transform.Rotation.from_matrix(keys.rotations)
    )
    own = np.broadcast_to(np.asarray(keys.degrees, np.float64), keys.times.shape)
    angles = scipy.interpolate.PchipInterpolator(keys.times, np.where(np.isnan(own), degrees, own))(times)
    focals = size[0] / (2 * np.tan(np.radians(angles) / 2))
    return [
        Camera(*size, (focal, focal), (size[0] / 2, size[1] / 2), rotation, -rotation @ position)
        for position, rotation, focal in zip(positions, turns(times).as_matrix(), focals)
    ]


def flight(scene: Scene, seconds: float) -> Keys:
    """A flight along the photos in the order of their names, smoothed, at a constant speed over the
    ground, with turns spread over some seconds. A long series is thinned out, or the film would
    rush."""
    count = len(scene.views)
    number = max(2, min(max(4, round(KEYS_A_SECOND * seconds)), count))
    chosen = [scene.views[i].camera for i in np.linspace(0, count - 1, number).round().astype(int)]
    positions = np.array([camera.position for camera in chosen])
    quaternions = scipy.spatial.transform.Rotation.from_matrix([camera.rotation for camera in chosen]).as_quat()
    # q and -q are the same turn
    opposite = (quaternions[1:] * quaternions[:-1]).sum(axis=1) < 0
    quaternions[1:] *= np.cumprod(np.where(opposite, -1, 1))[:, None]
    times = np.linspace(0, 1, int(np.clip(KEYS_OF_A_PATH * seconds, *PATH_KEYS)))
    coarse = np.arange(number)
    fine = np.linspace(0, number - 1, FINER * max(number, len(times)))
    curve = scipy.ndimage.gaussian_filter1d(
        scipy.interpolate.interp1d(coarse, positions, axis=0)(fine),
        SMOOTHING * len(fine) / number,
        axis=0,
        mode="nearest",
    )
    # a way of 0 would stand for two places at one time
    ways = np.linalg.norm(np.diff(curve, axis=0), axis=1)
    ways += LEAST_STEP * (np.abs(positions).max() or 1.0)
    along = np.concatenate([[0], np.cumsum(ways)])
    where = np.interp(times, along / along[-1], fine)
    turns = scipy.ndimage.gaussian_filter1d(
        scipy.interpolate.interp1d(coarse, quaternions, axis=0)(where),
        TURNING * len(times) / seconds,
        axis=0,
        mode="nearest",
    )
    return Keys(
        times,
        world_of(scene, scipy.interpolate.interp1d(fine, curve, axis=0)(where)),
        scipy.spatial.transform.Rotation.from_quat(turns).as_matrix(),
    )


def auto(scene: Scene, seconds: float) -> Keys:
    """The path that suits the photos: over the site and oblique if they look down, else `flight`."""
    slopes = [-float(view.camera.rotation[2] @ scene.up) for view in scene.views]
    down = np.median(slopes) >= math.cos(math.radians(LOOKS_DOWN))
    seen = shown_by([view.camera for view in scene.views], scene.points) >= LEAST_VIEWS
    places = scene.points[seen] if seen.any() else scene.points
    return _overflight(scene, places, seconds) if down and len(places) else flight(scene, seconds)


def _overflight(scene: Scene, places: NDArray[np.float64], seconds: float) -> Keys:
    """An arc around covered places [N, 3], local, or a flight along a long site."""
    up, middle = scene.up, np.median(places, axis=0)
    cameras = np.array([view.camera.position for view in scene.views])
    height = float(np.median((cameras - middle) @ up))
    plane = ground_axes(up, places, np.ones(len(places)))[:2]
    flat = (places - middle) @ plane.T
    low, high = np.quantile(flat, CORE, axis=0)
    half = (high - low) / 2
    below = math.radians(ELEVATION)
    # the ray through the upper border ends at this many distances beyond the middle
    beyond = math.sin(below) / math.tan(below - math.radians(UPPER)) - math.cos(below)
    distance = float(np.clip(half.min() / beyond, *np.multiply(DISTANCES, abs(height))))
    inside = flat[((low <= flat) & (flat <= high)).all(axis=1)]
    if half[0] > LONG * half[1] and len(inside) > MIDDLE_DEGREE:
        along = np.linspace(
            low[0] + min(0.2 * half[0], beyond * distance), high[0] - min(0.8 * half[0], beyond * distance), 61
        )
        across = Polynomial.fit(inside[:, 0], inside[:, 1], MIDDLE_DEGREE)(along)
        aims = middle + np.stack([along, across], axis=1) @ plane
        ahead = np.gradient(aims, axis=0)
        ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    else:
        ahead = _headings(scene, min(360.0, TURN * seconds))
        aims = np.zeros_like(ahead) + middle + (low + high) / 2 @ plane
    return replace(_looking_down(scene, aims, ahead, below, distance), degrees=OBLIQUE_DEGREES)


def _looking_down(
    scene: Scene, aims: NDArray[np.float64], ahead: NDArray[np.float64], below: float, distance: float
) -> Keys:
    """Keys at a distance from places [K, 3] at which they look, in horizontal directions [K, 3],
    so many radians below the horizon, at a constant speed."""
    forward = math.cos(below) * ahead - math.sin(below) * scene.up
    cameras = [Camera.looking_at(aim, aim - distance * each, up=scene.up) for aim, each in zip(aims, forward)]
    positions = world_of(scene, [camera.position for camera in cameras])
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])
    return Keys(along / along[-1], positions, np.array([each.rotation for each in cameras]))


def turntable(scene: Scene) -> Keys:
    """A full turn around the middle of the scene, about its up axis, that looks at the middle.

    It is as far away as the photos, and as high as they allow within ELEVATIONS.
    """
    if not len(scene.points):
        raise InputError(f"{scene.name}: has no points, so its middle is unknown; make a flight or give a camera path")
    up, middle = scene.up, np.median(scene.points, axis=0)
    away = np.array([view.camera.position for view in scene.views]) - middle
    distances = np.linalg.norm(away, axis=1)
    elevation = np.median(np.arcsin(np.clip(away @ up / np.maximum(distances, 1e-12), -1, 1)))
    ahead = -_headings(scene, 360.0)  # begins as the first view looks
    return _looking_down(
        scene,
        middle + np.zeros_like(ahead),
        ahead,
        float(np.clip(elevation, *np.radians(ELEVATIONS))),
        float(np.median(distances)) or scene.extent,
    )


def film_degrees(scene: Scene) -> float:
    """The horizontal angle of view of the photos, within DEGREES."""
    angles = [2 * math.degrees(math.atan(view.camera.width / 2 / view.camera.focal[0])) for view in scene.views]
    return float(np.clip(np.median(angles), *DEGREES))


def read_camera_path(path: Path) -> Keys:
    """Read a camera path: the part of transforms.json (instant-ngp, nerfstudio) that has poses.

    `frames` is a list of keys, each with `transform_matrix`, camera to world with camera axes
    right, up, back, in original coordinates. A key may have `time`, seconds, in which the keys must
    ascend; and the angle of view in radians, `camera_angle_x`, or else `fl_x` and `w`, pixels,
    which may also stand beside `frames` for all keys.

    Raises
    ------
    clsplat.ClsplatError : it is not such a file, or is damaged.
    """
    with reading(path, "a camera path", "it is JSON as transforms.json, see the guide"):
        table = object_of(read_regular(path))
        frames = [{**table, **frame} for frame in table["frames"]]
        if len(frames) == 1:  # the camera stands still
            frames = [{**frames[0], "time": time} for time in (0, 1)]
        matrices = np.array([frame["transform_matrix"] for frame in frames], np.float64)
        if matrices.shape[1:] not in ((3, 4), (4, 4)) or not (abs(matrices) <= LARGEST_COORDINATE).all():
            raise ValueError("transform_matrix is not a 3x4 or 4x4 matrix of numbers")
        turns = scipy.spatial.transform.Rotation.from_matrix((matrices[:, :3, :3] * FLIPPED).transpose(0, 2, 1))
        is_timed = any("time" in frame for frame in frames)
        times = np.array(
            [number(frame.get("time", None if is_timed else index), "time") for index, frame in enumerate(frames)]
        )
        shares = (times - times[0]) / ((times[-1] - times[0]) or 1)
        if (np.diff(shares) < LEAST_STEP).any():
            raise ValueError("time does not ascend")
        return Keys(shares, matrices[:, :3, 3], turns.as_matrix(), [_degrees(frame) for frame in frames])


def _degrees(frame: dict[str, Any]) -> float:
    if "camera_angle_x" in frame:
        angle = number(frame["camera_angle_x"], "camera_angle_x")
    elif "fl_x" in frame and "w" in frame:
        angle = 2 * math.atan2(number(frame["w"], "w") / 2, number(frame["fl_x"], "fl_x"))
    else:
        return math.nan
    if not 0 < angle < math.pi:
        raise ValueError("its angle of view is not between 0 and 180 degrees")
    return math.degrees(angle)


def _headings(scene: Scene, sweep: float) -> NDArray[np.float64]:
    """[181, 3]: horizontal directions that turn by `sweep` degrees about the one in which the
    scene's first view looks."""
    first, plane = scene.first_view.rotation, map_axes(scene.up)
    x, y = plane @ (first[2] - first[1])  # not vertical, even if it looks straight down
    angles = math.atan2(y, x) + np.radians(np.linspace(-sweep / 2, sweep / 2, 181))
    directions: NDArray[np.float64] = np.stack([np.cos(angles), np.sin(angles)], axis=1) @ plane
    return directions
