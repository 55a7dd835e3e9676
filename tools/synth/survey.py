"""A drone survey of a city: nadir and oblique cameras, and an ideal structure-from-motion.

The latter gives surface points with noise and the views that observe them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.errors import InputError
from tools.synth.city import BLOCK_WIDTH, PAVEMENT, STREET, TALLEST_BUILDING, City, sample
from tools.synth.raycast import cast

HALF_FIELD_OF_VIEW = np.deg2rad(30)  # horizontal
NADIR_SHARE = 0.4  # of all views
PITCH = np.deg2rad(50)  # of oblique views below the horizon, so that no sky is visible
GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))
POINTS_PER_BLOCK = 1100
GROUND_MARGIN = 10.0  # world units: width of the ground with points around the built area
NOISE_PIXELS = 0.3  # of observations, and of the points themselves at their mean distance
DETECTION_RATE = 0.45  # share of the views that see a point in which it is also detected
IMAGE_BORDER = 6  # pixels along the image border without observations
# of a flight over a large city
NADIR_SHARE_LARGE = 0.6
OVERLAP = 0.76  # of neighbouring nadir photos on the ground, along and across the strips
LEAST_ALTITUDE = 1.5 * TALLEST_BUILDING  # world units
DRIFT_WAVES = 5  # the most periods of an exposure drift in a flight
WHITE_BALANCE_SHARE = 0.25  # of the drift of red against blue in that of all colours


def survey(city: City, views: int, width: int, height: int, seed: int = 0) -> list[Camera]:
    """The cameras of a survey, all with the same intrinsics, nadir views first.

    The flying height follows from the area that each nadir view has to cover, so that neighbouring
    views overlap by about 60 % and several views see every inner point.
    """
    rng = np.random.default_rng([seed, 3])
    nadir = max(1, round(views * NADIR_SHARE))
    area = 4 * city.extent.prod()
    altitude = max(2.6 * np.sqrt(area / nadir), 2.2 * TALLEST_BUILDING)
    cameras = []
    for place in _grid(nadir, city.extent * 0.8):
        cameras.append(_downward(place, altitude, width, height, rng))
    return cameras + _obliques(city, _grid(views - nadir, city.extent * 0.6), altitude, width, height, rng)


def fly(city: City, views: int, width: int, height: int, pixel: float, seed: int = 0) -> list[Camera]:
    """The cameras of a large survey of so many views in the order of the flight: strips of nadir
    views, then strips of obliques.

    A `pixel` of a nadir view has so many world units on the ground, from which the altitude
    follows; the `seed` is that of the tilts of cameras and the like.
    """
    rng = np.random.default_rng([seed, 3])
    nadir = round(views * NADIR_SHARE_LARGE)
    altitude = pixel * focal_of(width)
    if altitude < LEAST_ALTITUDE:
        raise InputError(
            f"made city: a pixel of {pixel:g} units at a width of {width} needs an "
            f"altitude of {altitude:.1f} units, lower than {LEAST_ALTITUDE:g}"
        )
    return [
        _downward(place, altitude, width, height, rng) for place in _grid(nadir, city.extent, (width, height))
    ] + _obliques(city, _grid(views - nadir, city.extent, (width, height)), altitude, width, height, rng)


def blocks_for(views: int, width: int, height: int, pixel: float) -> int:
    """The blocks along each side of a city that `fly` covers with about OVERLAP."""
    nadir = views * NADIR_SHARE_LARGE
    side = float(np.sqrt(nadir * width * height)) * pixel * (1 - OVERLAP)
    return max(1, round(float(side - 2 * (STREET + PAVEMENT)) / BLOCK_WIDTH))


def overlap_of(city: City, views: int, width: int, height: int, pixel: float) -> float:
    """The share of the side of a nadir view, on the ground, that its neighbour in `fly` sees."""
    cell = 4 * city.extent.prod() / (views * NADIR_SHARE_LARGE)
    return 1 - float(np.sqrt(cell / (width * height))) / pixel


def gains(views: int, drift: float, seed: int = 0) -> NDArray[np.float64]:
    """Factors [V, 3] by which the light of each photo is multiplied: exposure and, less so, white
    balance drift slowly over the flight, by up to `drift` (0.15: 15 %)."""
    rng = np.random.default_rng([seed, 6])
    turns = np.linspace(0, 2 * np.pi, views)
    waves = [
        sum(np.sin(turns * rng.uniform(0.5, DRIFT_WAVES) + rng.uniform(0, 2 * np.pi)) for _ in range(4))
        for _ in range(2)
    ]
    exposure, balance = (wave / np.abs(wave).max() for wave in waves)
    warm = WHITE_BALANCE_SHARE * balance[:, None] * np.array([1.0, 0.0, -1.0])
    factors: NDArray[np.float64] = np.exp(np.log1p(drift) * (exposure[:, None] + warm))
    return factors


def _downward(place: NDArray[np.float64], altitude: float, width: int, height: int, rng: np.random.Generator) -> Camera:
    """A nadir camera over a place [2], nearly upright."""
    tilt = rng.normal(0, 0.03, 2)
    return looking(
        np.array([*place, altitude * rng.uniform(0.97, 1.03)]),
        np.array([*tilt, -1.0]),
        np.array([0, 1.0, 0]),
        width,
        height,
    )


def _obliques(
    city: City, places: NDArray[np.float64], altitude: float, width: int, height: int, rng: np.random.Generator
) -> list[Camera]:
    """Cameras that look obliquely at places [N, 2] of the ground from a little below the altitude."""
    cameras = []
    turn = rng.uniform(0, 2 * np.pi)
    for number, place in enumerate(places):
        # by the golden angle, so that neighbouring views see a facade from different sides
        heading = turn + number * GOLDEN_ANGLE
        ahead = place + 0.4 * altitude * np.array([np.cos(heading), np.sin(heading)])
        if (np.abs(ahead) > city.extent).any():
            heading += np.pi  # otherwise it would see the fields around the city
        pitch = PITCH + rng.uniform(-0.05, 0.05)
        forward = np.array([np.cos(heading) * np.cos(pitch), np.sin(heading) * np.cos(pitch), -np.sin(pitch)])
        low = 0.85 * altitude
        target = np.array([*place, 0.0])
        cameras.append(looking(target + forward * (low / forward[2]), forward, np.array([0, 0, 1.0]), width, height))
    return cameras


def _grid(count: int, reach: NDArray[np.float64], shape: tuple[float, float] = (1, 1)) -> NDArray[np.float64]:
    """`count` positions [count, 2] in rows that fill -reach to reach, alternating in direction;
    those of neighbours differ in x and y as the sides of `shape`."""
    most = count * reach[1] / reach[0] * (shape[0] / shape[1])
    rows = int(np.clip(round(np.sqrt(most)), 1, max(count, 1)))
    places: list[tuple[float, float]] = []
    for row, members in enumerate(np.array_split(np.arange(count), rows)):
        x = ((np.arange(len(members)) + 0.5) / max(len(members), 1) * 2 - 1) * reach[0]
        y = ((row + 0.5) / rows * 2 - 1) * reach[1]
        places += [(value, y) for value in (x if row % 2 == 0 else x[::-1])]
    return np.array(places).reshape(-1, 2)


def focal_of(width: int) -> float:
    """The focal length of the survey's camera, pixels, for a photo of this width."""
    return float(width / 2 / np.tan(HALF_FIELD_OF_VIEW))


def looking(
    position: NDArray[np.float64], forward: NDArray[np.float64], up: NDArray[np.float64], width: int, height: int
) -> Camera:
    """The survey's camera at `position` [3] that looks along `forward` [3] with `up` [3], in world."""
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    focal = focal_of(width)
    return Camera(width, height, (focal, focal), (width / 2, height / 2), rotation, -rotation @ position)


def observe(
    city: City, cameras: Sequence[Camera], seed: int = 0
) -> tuple[NDArray[np.float64], NDArray[np.integer], NDArray[np.integer], NDArray[np.float64]]:
    """Sample sparse points of the city and their observations.

    Points are dense in the middle and become sparse towards the border, as in a real survey.

    Returns the points [N, 3], world, with noise; and for each observation its point [M], its view
    [M] and its pixel [M, 2], sorted by point. Every point has at least two observations.
    """
    rng = np.random.default_rng([seed, 4])
    count = POINTS_PER_BLOCK * city.blocks[0] * city.blocks[1]
    surface = sample(city, 6 * count, GROUND_MARGIN, rng)
    reach = np.abs(surface[:, :2] / (city.extent + GROUND_MARGIN)).max(axis=1)
    surface = surface[rng.random(len(surface)) < np.clip(1.6 - 1.6 * reach, 0.05, 1)]

    seen = np.zeros((len(surface), len(cameras)), bool)
    pixels = np.zeros((len(surface), len(cameras), 2))
    footprint = np.zeros((len(surface), len(cameras)))  # world units a pixel
    for number, camera in enumerate(cameras):
        pixels[:, number], depth = camera.project(surface)
        footprint[:, number] = depth / camera.focal[0]
        size = np.array([camera.width, camera.height])
        border = min(IMAGE_BORDER, size.min() / 8)
        inside = np.flatnonzero(
            (depth > 0) & (pixels[:, number] > border).all(axis=1) & (pixels[:, number] < size - border).all(axis=1)
        )
        met, _ = cast(city, camera, pixels[inside, number])
        seen[inside, number] = np.linalg.norm(met - surface[inside], axis=1) < 1e-3
    seen &= rng.random(seen.shape) < DETECTION_RATE
    kept = np.flatnonzero(seen.sum(axis=1) >= 2)[:count]
    surface, seen, pixels = surface[kept], seen[kept], pixels[kept]

    spread = NOISE_PIXELS * (footprint[kept] * seen).sum(axis=1) / seen.sum(axis=1)
    offset = np.clip(rng.normal(size=surface.shape), -3, 3) / np.sqrt(3)
    point, view = np.nonzero(seen)
    noise = np.clip(rng.normal(0, NOISE_PIXELS, (len(point), 2)), -3 * NOISE_PIXELS, 3 * NOISE_PIXELS)
    return surface + offset * spread[:, None], point, view, pixels[point, view] + noise
