"""An ideal structure-from-motion: surface points, their noise, and who sees them."""

import numpy as np

from clsplat.synth.geometry import sample
from clsplat.synth.raycast import cast

POINTS_A_BLOCK = 1100
MARGIN = 10.0  # of ground around the built area that gets points, world units
NOISE_PIXELS = 0.3  # of observations, and of the points themselves at their mean distance
DETECTED = 0.45  # share of the views that see a point in which it is also found
BORDER = 6  # pixels along the image border without observations


def observe(city, cameras, seed=0):
    """Sparse points of the city and their observations.

    Returns points float64[N, 3], world, noisy; and rows point int[M], view int[M], pixel
    float64[M, 2], sorted by point. Every point has at least two rows. Points are dense in the
    middle and thin out towards the border, as in a real survey.
    """
    rng = np.random.default_rng([seed, 4])
    wanted = POINTS_A_BLOCK * city.blocks[0] * city.blocks[1]
    surface = sample(city, 6 * wanted, MARGIN, rng)
    reach = np.abs(surface[:, :2] / (city.extent + MARGIN)).max(axis=1)
    surface = surface[rng.random(len(surface)) < np.clip(1.6 - 1.6 * reach, 0.05, 1)]

    seen = np.zeros((len(surface), len(cameras)), bool)
    pixels = np.zeros((len(surface), len(cameras), 2))
    footprint = np.zeros((len(surface), len(cameras)))  # world units a pixel
    for number, camera in enumerate(cameras):
        pixels[:, number], depth = camera.project(surface)
        footprint[:, number] = depth / camera.focal[0]
        size = np.array([camera.width, camera.height])
        border = min(BORDER, size.min() / 8)
        inside = np.flatnonzero((depth > 0) & (pixels[:, number] > border).all(axis=1)
                                & (pixels[:, number] < size - border).all(axis=1))
        met, _ = cast(city, camera, pixels[inside, number])
        seen[inside, number] = np.linalg.norm(met - surface[inside], axis=1) < 1e-3
    seen &= rng.random(seen.shape) < DETECTED
    kept = np.flatnonzero(seen.sum(axis=1) >= 2)[:wanted]
    surface, seen, pixels = surface[kept], seen[kept], pixels[kept]

    spread = NOISE_PIXELS * (footprint[kept] * seen).sum(axis=1) / seen.sum(axis=1)
    offset = np.clip(rng.normal(size=surface.shape), -3, 3) / np.sqrt(3)
    point, view = np.nonzero(seen)
    noise = np.clip(rng.normal(0, NOISE_PIXELS, (len(point), 2)), -3 * NOISE_PIXELS,
                    3 * NOISE_PIXELS)
    return surface + offset * spread[:, None], point, view, pixels[point, view] + noise
