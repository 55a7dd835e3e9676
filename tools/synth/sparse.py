"""Sparse points of a large survey, as an ideal structure-from-motion would find them on a device.

Candidates are points of all surfaces. The kernel `observe` says which views see one and detect it;
only these observations are ever in memory.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from tools.synth.city import City, sample_solids
from tools.synth.draw import DeviceCity
from tools.synth.survey import GROUND_MARGIN, NOISE_PIXELS

CHUNK = 1 << 17  # candidates that are tried at the same time
LEAST_YIELD = 0.002  # share of a chunk's candidates that must become points
MOST_NOISE = 3  # standard deviations


class Sparse(NamedTuple):
    """Sparse points and where they were seen."""

    points: NDArray[np.float64]  # [N, 3], world, with noise
    colours: NDArray[np.uint8]  # [N, 3]
    # of M observations, sorted by point
    point: NDArray[np.int32]
    view: NDArray[np.int32]
    pixels: NDArray[np.float64]  # [M, 2], with noise


def observe_on(drawn: DeviceCity, city: City, cameras: Sequence[Camera], count: int, seed: int = 0) -> Sparse:
    """Sample up to `count` points, each of which at least two cameras of one size observe.

    There are fewer if hardly any candidates are seen.
    """
    size = cameras[0].width, cameras[0].height
    packed = drawn.cameras(cameras)
    stacked = (np.stack([camera.rotation for camera in cameras]), np.stack([camera.position for camera in cameras]))
    parts: list[Sparse] = []
    done = tried = 0
    while done < count:
        rng = np.random.default_rng([seed, 4, tried])
        points, solids = sample_solids(city, CHUNK, GROUND_MARGIN, rng)
        seen = drawn.observed(points, solids, packed, size, tried * CHUNK, seed)
        kept = np.flatnonzero(seen.counts >= 2)[: count - done]
        taken = np.arange(seen.views.shape[1]) < seen.counts[kept, None]
        point = np.nonzero(taken)[0].astype(np.int32)
        view = seen.views[kept][taken].astype(np.int32)
        noisy, pixels = _measured(points[kept], point, view, cameras[0], stacked, rng)
        parts.append(Sparse(noisy, seen.colours[kept], point + np.int32(done), view, pixels))
        done, tried = done + len(kept), tried + 1
        if len(kept) < LEAST_YIELD * CHUNK:
            break
    return Sparse(*map(np.concatenate, zip(*parts)))


def _measured(
    points: NDArray[np.float64],
    point: NDArray[np.int32],
    view: NDArray[np.int32],
    camera: Camera,
    stacked: tuple[NDArray[np.float64], NDArray[np.float64]],
    rng: np.random.Generator,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The points with noise, and the pixels of their observations with noise.

    Parameters
    ----------
    points : [N, 3], world, without noise.
    point, view : [M], of each observation.
    camera : any of the cameras, which have the same intrinsics.
    stacked : rotations [V, 3, 3] and positions [V, 3] of the cameras.
    rng : the source of randomness.
    """
    rotations, positions = stacked
    rays = np.einsum("nij,nj->ni", rotations[view], points[point] - positions[view])
    pixels = rays[:, :2] / rays[:, 2:] * camera.focal + camera.centre
    noise = np.clip(rng.normal(size=pixels.shape), -MOST_NOISE, MOST_NOISE) * NOISE_PIXELS
    # of a point itself as of a pixel at its mean distance
    counts = np.maximum(np.bincount(point, minlength=len(points)), 1)
    footprint = np.bincount(point, rays[:, 2], len(points)) / counts / camera.focal[0]
    offset = np.clip(rng.normal(size=points.shape), -MOST_NOISE, MOST_NOISE) / np.sqrt(3)
    return points + offset * (NOISE_PIXELS * footprint)[:, None], pixels + noise
