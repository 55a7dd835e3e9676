"""The cameras of a drone survey: a grid of nadir views and a grid of oblique views."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.synth.layout import TALLEST_BUILDING

if TYPE_CHECKING:
    from clsplat.synth.geometry import City

HALF_FIELD_OF_VIEW = np.deg2rad(30)  # horizontal
NADIR_SHARE = 0.4  # of all views
PITCH = np.deg2rad(50)  # of oblique views below the horizon, so that no sky is visible
GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))


def survey(city: City, views: int, width: int, height: int, seed: int = 0) -> list[Camera]:
    """The cameras of a survey, all with the same intrinsics, nadir views first.

    The flying height follows from the area that each nadir view has to cover, so that neighbouring
    views overlap by about 60 % and several views see every inner point.

    Parameters
    ----------
    city : the world.
    views : the number of cameras.
    width : of an image, pixels.
    height : of an image, pixels.
    seed : of the random deviations from the plan.
    """
    rng = np.random.default_rng([seed, 3])
    nadir = max(1, round(views * NADIR_SHARE))
    area = 4 * city.extent.prod()
    altitude = max(2.6 * np.sqrt(area / nadir), 2.2 * TALLEST_BUILDING)
    cameras = []
    for place in _grid(nadir, city.extent * 0.8):
        tilt = rng.normal(0, 0.03, 2)
        cameras.append(looking(
            np.array([*place, altitude * rng.uniform(0.97, 1.03)]), np.array([*tilt, -1.0]),
            np.array([0, 1.0, 0]), width, height))
    turn = rng.uniform(0, 2 * np.pi)
    for number, place in enumerate(_grid(views - nadir, city.extent * 0.6)):
        # by the golden angle, so that neighbouring views see a facade from different sides
        heading = turn + number * GOLDEN_ANGLE
        ahead = place + 0.4 * altitude * np.array([np.cos(heading), np.sin(heading)])
        if (np.abs(ahead) > city.extent).any():
            heading += np.pi  # otherwise it would see the fields around the city
        pitch = PITCH + rng.uniform(-0.05, 0.05)
        forward = np.array([np.cos(heading) * np.cos(pitch), np.sin(heading) * np.cos(pitch),
                            -np.sin(pitch)])
        low = 0.85 * altitude
        target = np.array([*place, 0.0])
        cameras.append(looking(target + forward * (low / forward[2]), forward,
                               np.array([0, 0, 1.0]), width, height))
    return cameras


def _grid(count: int, reach: NDArray[np.float64]) -> NDArray[np.float64]:
    """`count` positions [count, 2] in rows that fill -reach to reach, alternating in direction."""
    rows = int(np.clip(round(np.sqrt(count * reach[1] / reach[0])), 1, max(count, 1)))
    places: list[tuple[float, float]] = []
    for row, members in enumerate(np.array_split(np.arange(count), rows)):
        x = ((np.arange(len(members)) + 0.5) / max(len(members), 1) * 2 - 1) * reach[0]
        y = ((row + 0.5) / rows * 2 - 1) * reach[1]
        places += [(value, y) for value in (x if row % 2 == 0 else x[::-1])]
    return np.array(places).reshape(-1, 2)


def looking(position: NDArray[np.float64], forward: NDArray[np.float64],
            up: NDArray[np.float64], width: int, height: int) -> Camera:
    """The survey's camera at `position` [3] that looks along `forward` [3] with `up` [3], in world.
    """
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    focal = width / 2 / np.tan(HALF_FIELD_OF_VIEW)
    return Camera(width, height, (focal, focal), (width / 2, height / 2), rotation,
                  -rotation @ position)
