"""The path of a film over a survey whose photos look down: oblique, at a constant speed."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from clsplat.apps.camera_path import Keys, flight
from clsplat.apps.orthophoto import LEAST_VIEWS, shown_by
from clsplat.camera import Camera
from clsplat.scene import Scene

LOOKS_DOWN = 45.0  # degrees from the vertical, median of the photos
ELEVATION = 45.0  # degrees below the horizon, to which the film looks
DEGREES = 50.0  # horizontal angle of view: a wider one would show what lies beyond the photos
UPPER = 17.0  # degrees above the middle of the picture, which must still show covered ground
TURN = 6.0  # degrees a second around the middle of the site
LONG = 2.5  # a site so many times as long as wide is flown along
CORE = (0.05, 0.95)  # quantiles of the covered places that bound the site
DISTANCES = (0.5, 1.3)  # from where the film looks, least and most, in heights of the flight
STRIP = 0.15  # of the length of a site, the standard deviation by which its middle line is smoothed


def auto(scene: Scene, seconds: float) -> Keys:
    """The path that suits the photos: `overflight` if they look down, else `flight`.

    Parameters
    ----------
    scene : its cameras and sparse points.
    seconds : length of the film.
    """
    slopes = [-float(view.camera.rotation[2] @ scene.up) for view in scene.views]
    down = np.median(slopes) >= math.cos(math.radians(LOOKS_DOWN))
    places = _covered(scene)
    return overflight(scene, places, seconds) if down and len(places) else flight(scene, seconds)


def overflight(scene: Scene, places: NDArray[np.float64], seconds: float) -> Keys:
    """An arc around the middle of a site, or a flight along a long one, that looks at covered
    ground.

    Parameters
    ----------
    scene : whose photos look down.
    places : float64[N, 3], local; what at least two photos show.
    seconds : length of the film.
    """
    up, middle = scene.up, np.median(places, axis=0)
    cameras = np.array([view.camera.position for view in scene.views])
    height = float(np.median((cameras - middle) @ up))
    plane = _axes(places, up)
    flat = (places - middle) @ plane.T
    low, high = np.quantile(flat, CORE, axis=0)
    half = (high - low) / 2
    below = math.radians(ELEVATION)
    # the ray through the upper border ends at this many distances beyond the middle
    beyond = math.sin(below) / math.tan(below - math.radians(UPPER)) - math.cos(below)
    distance = float(np.clip(half.min() / beyond, *np.multiply(DISTANCES, abs(height))))
    if half[0] > LONG * half[1]:
        targets = _middle_line(flat, low[0], high[0], beyond * distance)
        ahead = np.gradient(targets, axis=0)
    else:
        sweep = math.radians(min(360.0, TURN * seconds))
        angles = np.linspace(-sweep / 2, sweep / 2, 181)
        targets = np.zeros((len(angles), 2)) + (low + high) / 2
        first = _heading(scene, plane)
        ahead = np.stack([np.cos(first + angles), np.sin(first + angles)], axis=1)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    forward = math.cos(below) * ahead @ plane - math.sin(below) * up
    aims = middle + targets @ plane
    views = [Camera.looking_at(aim, aim - distance * each, up=up)
             for aim, each in zip(aims, forward)]
    positions = scene.offset + scene.unit * np.array([view.position for view in views])
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])
    return Keys(along / along[-1], positions, np.array([view.rotation for view in views]),
                np.full(len(views), DEGREES))


def _covered(scene: Scene) -> NDArray[np.float64]:
    """[N, 3], local: the sparse points that at least two photos show; all if there are none."""
    seen = shown_by([view.camera for view in scene.views], scene.points) >= LEAST_VIEWS
    return scene.points[seen] if seen.any() else scene.points


def _axes(places: NDArray[np.float64], up: NDArray[np.float64]) -> NDArray[np.float64]:
    """[2, 3]: horizontal unit vectors along the longer and the shorter side of places."""
    first = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    plane = np.stack([first, np.cross(up, first)]) / np.linalg.norm(first)
    flat = (places - places.mean(axis=0)) @ plane.T
    axes: NDArray[np.float64] = np.linalg.eigh(flat.T @ flat)[1].T[::-1] @ plane
    return axes


def _heading(scene: Scene, plane: NDArray[np.float64]) -> float:
    """The angle on a plane in which the scene's first view looks."""
    first = scene.first_view.rotation
    x, y = plane @ (first[2] - first[1])  # not vertical, even if it looks straight down
    return math.atan2(y, x)


def _middle_line(flat: NDArray[np.float64], low: float, high: float, margin: float
                 ) -> NDArray[np.float64]:
    """[K, 2]: the smoothed line along the middle of places [N, 2], a margin from its ends."""
    length = high - low
    along = np.linspace(low + min(0.1 * length, margin), high - min(0.4 * length, margin), 61)
    window = length / 20
    across = np.array([np.median(beside) if len(beside := flat[abs(flat[:, 0] - x) < window, 1])
                       else np.nan for x in along])
    gaps = np.isnan(across)
    across[gaps] = np.interp(along[gaps], along[~gaps], across[~gaps])
    across = gaussian_filter1d(across, STRIP * len(along), mode="nearest")
    return np.stack([along, across], axis=1)
