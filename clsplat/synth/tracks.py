"""An ideal structure-from-motion: surface points with noise, and the views that observe them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsplat.synth.geometry import sample
from clsplat.synth.raycast import cast

if TYPE_CHECKING:
    from clsplat.camera import Camera
    from clsplat.synth.geometry import City

POINTS_PER_BLOCK = 1100
GROUND_MARGIN = 10.0  # world units: width of the ground with points around the built area
NOISE_PIXELS = 0.3  # of observations, and of the points themselves at their mean distance
DETECTION_RATE = 0.45  # share of the views that see a point in which it is also detected
IMAGE_BORDER = 6  # pixels along the image border without observations


def observe(city: City, cameras: Sequence[Camera], seed: int = 0
            ) -> tuple[NDArray[np.float64], NDArray[np.integer], NDArray[np.integer],
                       NDArray[np.float64]]:
    """Sample sparse points of the city and their observations.

    Points are dense in the middle and become sparse towards the border, as in a real survey.

    Returns
    -------
    The points [N, 3], world, with noise; and for each observation its point [M], its view [M] and
    its pixel [M, 2], sorted by point. Every point has at least two observations.
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
        inside = np.flatnonzero((depth > 0) & (pixels[:, number] > border).all(axis=1)
                                & (pixels[:, number] < size - border).all(axis=1))
        met, _ = cast(city, camera, pixels[inside, number])
        seen[inside, number] = np.linalg.norm(met - surface[inside], axis=1) < 1e-3
    seen &= rng.random(seen.shape) < DETECTION_RATE
    kept = np.flatnonzero(seen.sum(axis=1) >= 2)[:count]
    surface, seen, pixels = surface[kept], seen[kept], pixels[kept]

    spread = NOISE_PIXELS * (footprint[kept] * seen).sum(axis=1) / seen.sum(axis=1)
    offset = np.clip(rng.normal(size=surface.shape), -3, 3) / np.sqrt(3)
    point, view = np.nonzero(seen)
    noise = np.clip(rng.normal(0, NOISE_PIXELS, (len(point), 2)), -3 * NOISE_PIXELS,
                    3 * NOISE_PIXELS)
    return surface + offset * spread[:, None], point, view, pixels[point, view] + noise
