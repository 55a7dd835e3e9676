"""The drone's survey: a grid that looks straight down and one that looks at an angle."""

import numpy as np

from clsplat.camera import Camera
from clsplat.synth.layout import TALLEST

HALF_FIELD = np.deg2rad(30)  # of view, horizontally
NADIR_SHARE = 0.4
PITCH = np.deg2rad(50)  # of oblique views below the horizon: they see no sky
GOLDEN = np.pi * (3 - np.sqrt(5))


def survey(city, views, width, height, seed=0):
    """`views` cameras over the city, all with the same intrinsics, nadir views first.

    The flying height follows from the area each nadir view has to cover, so that neighbouring
    views overlap by about 60 % and every inner point is seen several times.
    """
    rng = np.random.default_rng([seed, 3])
    nadir = max(1, round(views * NADIR_SHARE))
    area = 4 * city.extent.prod()
    altitude = max(2.6 * np.sqrt(area / nadir), 2.2 * TALLEST)
    cameras = []
    for place in _grid(nadir, city.extent * 0.8):
        tilt = rng.normal(0, 0.03, 2)
        cameras.append(looking(
            np.array([*place, altitude * rng.uniform(0.97, 1.03)]), np.array([*tilt, -1.0]),
            np.array([0, 1.0, 0]), width, height))
    turn = rng.uniform(0, 2 * np.pi)
    for number, place in enumerate(_grid(views - nadir, city.extent * 0.6)):
        # golden angle: whichever neighbours see a facade, they see it from other sides
        heading = turn + number * GOLDEN
        ahead = place + 0.4 * altitude * np.array([np.cos(heading), np.sin(heading)])
        if (np.abs(ahead) > city.extent).any():
            heading += np.pi  # it would look out over the fields
        pitch = PITCH + rng.uniform(-0.05, 0.05)
        forward = np.array([np.cos(heading) * np.cos(pitch), np.sin(heading) * np.cos(pitch),
                            -np.sin(pitch)])
        low = 0.85 * altitude
        target = np.array([*place, 0.0])
        cameras.append(looking(target + forward * (low / forward[2]), forward,
                               np.array([0, 0, 1.0]), width, height))
    return cameras


def _grid(count, reach):
    """`count` places float64[count, 2] in rows that fill -reach..reach, flown to and fro."""
    rows = int(np.clip(round(np.sqrt(count * reach[1] / reach[0])), 1, max(count, 1)))
    places = []
    for row, members in enumerate(np.array_split(np.arange(count), rows)):
        x = ((np.arange(len(members)) + 0.5) / max(len(members), 1) * 2 - 1) * reach[0]
        y = ((row + 0.5) / rows * 2 - 1) * reach[1]
        places += [(value, y) for value in (x if row % 2 == 0 else x[::-1])]
    return np.array(places).reshape(-1, 2)


def looking(position, forward, up, width, height):
    """The survey's camera at `position`, looking along `forward` with `up` upwards, all world."""
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    focal = width / 2 / np.tan(HALF_FIELD)
    return Camera(width, height, (focal, focal), (width / 2, height / 2), rotation,
                  -rotation @ position)
