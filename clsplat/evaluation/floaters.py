"""Floaters: the gaussians of a model that are away from the true surfaces of a synthetic city."""

import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise, product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import expit

from clsplat.camera import Camera
from clsplat.gaussians import Gaussians
from clsplat.synth.geometry import City, distance, load
from clsplat.synth.write import GEOMETRY

TOLERANCES = (1, 3, 10)  # pixels within which a gaussian counts as on the surface
CAMERAS = 64  # that are compared at once
CHUNK = 1 << 12  # neighbouring gaussians at once, which few solids and cameras concern


def ground_truth(scene_path: Path) -> City | None:
    """The city that a scene shows, or None where that is not known; InputError if damaged."""
    path = scene_path / GEOMETRY
    return load(path) if path.is_file() else None


def floater_share(city: City, gaussians: Gaussians, cameras: Sequence[Camera],
                  offset: NDArray[np.float64]) -> dict[str, float]:
    """The share of opacity whose gaussians lie farther from the true surface than a pixel there.

    A pixel's footprint is depth / fx in the camera for which that is least. Occlusion is ignored,
    and a centre that no camera sees has its distance to the nearest camera as depth.

    Parameters
    ----------
    city : in original world coordinates.
    gaussians : in local coordinates.
    cameras : the training cameras, local, at the size trained on.
    offset : [3], of the scene; original = local + offset.

    Returns
    -------
    {"floaters", "floaters_3", "floaters_10"}: 0 to 1, beyond 1, 3 and 10 pixels; 0 without
    gaussians.
    """
    positions = gaussians.positions.astype(np.float64)
    opacity = expit(gaussians.opacity_logits.astype(np.float64))
    floating = np.zeros(len(TOLERANCES))
    planes = np.array([_planes(camera) for camera in cameras])
    bounds = city.bounds[:, :, :2]

    def floating_among(rows: NDArray[np.integer]) -> list[float]:
        world = positions[rows] + offset
        footprint = _footprint(positions[rows], cameras, planes)
        near = _near(bounds, world, max(TOLERANCES) * footprint.max())
        away = distance(city.part(near), world)
        return [opacity[rows] @ (away > pixels * footprint) for pixels in TOLERANCES]

    with ThreadPoolExecutor() as threads:
        for part in threads.map(floating_among, _neighbours_together(positions)):
            floating += part
    shares = floating / max(opacity.sum(), np.finfo(float).tiny)
    return {"floaters" if pixels == 1 else f"floaters_{pixels}": float(share)
            for pixels, share in zip(TOLERANCES, shares)}


def _neighbours_together(points: NDArray[np.float64]) -> Iterator[NDArray[np.integer]]:
    """Indices of points [N, 3] in groups of at most CHUNK neighbours, int[n] for each group."""
    if not len(points):
        return
    parts = 2 ** max(0, math.ceil(math.log2(len(points) / CHUNK)))
    order = cKDTree(points, leafsize=CHUNK, compact_nodes=False).indices
    for begin, end in pairwise(len(points) * np.arange(parts + 1) // parts):
        yield order[begin:end]


def _near(bounds: NDArray[np.float64], points: NDArray[np.float64], reach: float
          ) -> NDArray[np.bool_]:
    """Which solids are as near to points as `reach`, and as the ground is to the highest of them.

    Without the others, `distance` finds the same wherever that is at most `reach`, and elsewhere
    more than `reach`.

    Parameters
    ----------
    bounds : [K, 2, 2], those of the city's solids along x and y.
    points : [N, 3], in the city's frame.
    """
    low, high = bounds[:, 0], bounds[:, 1]
    gap = np.maximum(low - points[:, :2].max(axis=0), points[:, :2].min(axis=0) - high).max(axis=1)
    near: NDArray[np.bool_] = gap <= min(reach, points[:, 2].max())
    return near


def _footprint(points: NDArray[np.float64], cameras: Sequence[Camera],
               planes: NDArray[np.float64]) -> NDArray[np.float64]:
    """World units a pixel, [N], at points [N, 3].

    Parameters
    ----------
    planes : [C, 5, 4], the result of `_planes` for each camera.
    """
    focal = np.array([camera.focal[0] for camera in cameras])
    ends = zip(points.min(axis=0), points.max(axis=0))
    corners = np.array([*product(*ends, [1])])
    # a camera may see some of the points unless one of its planes has all corners behind it
    may_see = ((planes @ corners.T).max(axis=2) >= 0).all(axis=1)
    footprint = np.full(len(points), np.inf)
    homogeneous = np.column_stack([points, np.ones(len(points))]).T
    chosen = np.flatnonzero(may_see)
    for begin in range(0, len(chosen), CAMERAS):
        some = chosen[begin:begin + CAMERAS]
        inside = planes[some] @ homogeneous
        sees = (inside >= 0).all(axis=1)
        size = np.where(sees, inside[:, 0] / focal[some, None], np.inf)
        np.minimum(footprint, size.min(axis=0), out=footprint)
    unseen = np.isinf(footprint)
    if unseen.any():
        away, nearest = cKDTree([camera.position for camera in cameras]).query(points[unseen])
        footprint[unseen] = away / focal[nearest]
    return footprint


def _planes(camera: Camera) -> NDArray[np.float64]:
    """[5, 4]: a point (x, y, z, 1) is in the image where all five products are >= 0.

    The first product is its depth, the others are depth times its pixels from the image's sides.
    """
    depth = np.append(camera.rotation[2], camera.translation[2])
    sides = []
    for axis, size in enumerate((camera.width, camera.height)):
        across = np.append(camera.rotation[axis], camera.translation[axis])
        first = camera.focal[axis] * across + camera.centre[axis] * depth
        sides += [first, size * depth - first]
    return np.array([depth, *sides])
