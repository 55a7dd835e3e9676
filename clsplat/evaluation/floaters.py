"""How much of a model floats: gaussians away from the true surfaces of a synthetic city."""

from dataclasses import replace
from itertools import product

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import expit

from clsplat.synth.geometry import BLOCK_WIDTH, distance, load
from clsplat.synth.write import GEOMETRY

PIXELS = (1, 3, 10)  # footprints within which a gaussian counts as on the surface
CHUNK = 1 << 12  # gaussians at once: neighbours, so that few solids and cameras concern them


def geometry_path(scene_path):
    """Where the ground truth of a scene lies if it has one: geometry.json in its folder;
    NAME.geometry.json beside a packed NAME.npz."""
    return (scene_path / GEOMETRY if scene_path.is_dir()
            else scene_path.with_suffix(f".{GEOMETRY}"))


def ground_truth(scene_path):
    """The City that a scene shows, or None where that is not known; InputError if damaged."""
    path = geometry_path(scene_path)
    return load(path) if path.is_file() else None


def floater_share(city, gaussians, cameras, offset):
    """The share of opacity whose gaussians lie farther from the true surface than a pixel there.

    city: synth.geometry.City, in original world coordinates; gaussians: Gaussians, in local ones;
    cameras: the training Cameras, local, at the size trained on; offset: float64[3] of the scene,
    original = local + offset. Returns {"floaters", "floaters_3", "floaters_10"}: 0..1, beyond 1, 3
    and 10 pixels; 0 without gaussians.

    A pixel's footprint is depth / fx in the camera that sees the centre most closely: occlusion is
    ignored, and a centre that none sees takes its distance to the nearest camera as depth.
    """
    positions = gaussians.positions.astype(np.float64)
    opacity = expit(gaussians.opacity_logits.astype(np.float64))
    floating = np.zeros(len(PIXELS))
    order = _neighbours_together(positions + offset)
    for begin in range(0, len(order), CHUNK):
        rows = order[begin:begin + CHUNK]
        world = positions[rows] + offset
        away = distance(_around(city, world), world)
        footprint = _footprint(positions[rows], cameras)
        floating += [opacity[rows] @ (away > pixels * footprint) for pixels in PIXELS]
    shares = floating / max(opacity.sum(), np.finfo(float).tiny)
    return {"floaters" if pixels == 1 else f"floaters_{pixels}": float(share)
            for pixels, share in zip(PIXELS, shares)}


def _neighbours_together(points):
    """An order int[N] of points float64[N, 3]: by octave of height, then by city block."""
    x, y = np.floor(points[:, :2] / BLOCK_WIDTH).T
    return np.lexsort((y, x, np.ceil(np.log2(points[:, 2].clip(1)))))


def _around(city, points):
    """The city without the solids that cannot change the distance of any of the points.

    `distance` takes the least signed one; the ground's is at most the points' largest height, and
    a solid's at least its distance sideways.
    """
    low, high = city.bounds[:, 0, :2], city.bounds[:, 1, :2]
    gap = np.maximum(low - points[:, :2].max(axis=0), points[:, :2].min(axis=0) - high).max(axis=1)
    near = gap <= points[:, 2].max()
    boxes, spheres = np.split(near, [len(city.boxes)])
    return replace(city, boxes=city.boxes[boxes], kinds=city.kinds[boxes],
                   spheres=city.spheres[spheres])


def _footprint(points, cameras):
    """World units a pixel, float64[N], at points float64[N, 3]."""
    planes = np.array([_planes(camera) for camera in cameras])
    focal = np.array([camera.focal[0] for camera in cameras])
    ends = zip(points.min(axis=0), points.max(axis=0))
    corners = np.array([*product(*ends, [1])])
    # a camera may see some of the points unless one of its planes has all corners behind it
    able = ((planes @ corners.T).max(axis=2) >= 0).all(axis=1)
    footprint = np.full(len(points), np.inf)
    homogeneous = np.column_stack([points, np.ones(len(points))]).T
    for camera in np.flatnonzero(able):
        inside = planes[camera] @ homogeneous
        sees = (inside >= 0).all(axis=0)
        footprint[sees] = np.minimum(footprint[sees], inside[0, sees] / focal[camera])
    unseen = np.isinf(footprint)
    if unseen.any():
        away, nearest = cKDTree([camera.position for camera in cameras]).query(points[unseen])
        footprint[unseen] = away / focal[nearest]
    return footprint


def _planes(camera):
    """float64[5, 4]: a point (x, y, z, 1) is in the image where all five products are >= 0; the
    first is its depth, the others are depth times its pixels from the image's four sides."""
    depth = np.append(camera.rotation[2], camera.translation[2])
    sides = []
    for axis, size in enumerate((camera.width, camera.height)):
        across = np.append(camera.rotation[axis], camera.translation[axis])
        first = camera.focal[axis] * across + camera.centre[axis] * depth
        sides += [first, size * depth - first]
    return np.array([depth, *sides])
