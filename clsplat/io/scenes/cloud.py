"""Initial point clouds for data sets that have poses but no sparse model."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from clsplat.errors import InputError
from clsplat.io.fields import LARGEST_COORDINATE
from clsplat.io.models.ply import read_vertices
from clsplat.io.scenes.colmap import read_model
from clsplat.scene import View

PLY_NAMES = ("points3D.ply", "sparse_pc.ply")
COLOURS = ("red", "green", "blue")
# sampled points: a view, and in all
POINTS_A_VIEW, MOST_POINTS, FEWEST_POINTS = 500, 500_000, 100
MOST_ROUNDS = 8
NEIGHBOURS = 16  # nearest views, of which one more must see a sampled point
DEPTHS = (0.5, 8.0)  # of sampled points, in distances to the farthest of those neighbours
LEAST_ANGLE = np.radians(1.0)  # between two views of a sampled point


@dataclass(frozen=True, eq=False)
class Cloud:
    """The sparse points of a data set or a project.

    Attributes
    ----------
    positions : float64[N, 3], world.
    colours : uint8[N, 3]; None: unknown.
    observations : int[M, 2], rows (point, photo); None: unknown.
    """

    positions: NDArray[np.float64]
    colours: NDArray[np.uint8] | None = None
    observations: NDArray[np.int64] | None = None


def read_cloud(folder: Path, ply: Path | None, transform: NDArray[np.float64]) -> Cloud | None:
    """Read the points of a scene folder: points3D.ply, sparse_pc.ply, or else a COLMAP model in the
    folder or in colmap/; None if all are missing.

    Parameters
    ----------
    ply : a file that must exist, and is used instead.
    transform : float64[3, 4], from the world of the COLMAP model to that of the poses.
    """
    if ply is not None:
        return _ply_cloud(ply)
    for path in (folder / name for name in PLY_NAMES):
        if path.exists():
            return _ply_cloud(path)
    for place in (folder, folder / "colmap"):
        if (place / "sparse").is_dir():
            _, arrays = read_model(place)
            return Cloud(arrays["points"] @ transform[:, :3].T + transform[:, 3],
                         arrays["colours"])
    return None


def _ply_cloud(path: Path) -> Cloud:
    rows = read_vertices(path)[0].data
    kinds = {name: rows.dtype[name].kind for name in rows.dtype.names}
    if any(kinds.get(name, "") not in tuple("fiu") for name in "xyz"):
        raise InputError(f"{path}: its vertices have no x, y, z; give a PLY of points")
    points = np.stack([rows[name].astype(np.float64) for name in "xyz"], axis=1)
    if any(name not in kinds or rows.dtype[name] != np.uint8 for name in COLOURS):
        return Cloud(points)
    return Cloud(points, np.stack([rows[name] for name in COLOURS], axis=1))


def sample_points(path: str | Path, views: Sequence[View]) -> NDArray[np.float64]:
    """Sample random points, float64[N, 3], in the volume that at least two of the views see.

    Each point lies on the ray of a random pixel of a random view, at a depth whose logarithm is
    uniform from 0.5 to 8 times the distance to the 16th nearest view, and is kept if one of those
    16 views sees it too, from a direction at least a degree apart. The same views give the same
    points (seed 0). InputError, which names the path, if hardly a point is kept.
    """
    random = np.random.default_rng(0)
    count = min(POINTS_A_VIEW * len(views), MOST_POINTS)
    cameras = [view.camera for view in views]
    rotation, translation, focal, centre, size, position = map(np.array, zip(*(
        (camera.rotation, camera.translation, camera.focal, camera.centre,
         (camera.width, camera.height), camera.position) for camera in cameras), strict=True))
    most = min(NEIGHBOURS + 1, len(cameras))
    away, nearest = cKDTree(position).query(position, [*range(1, most + 1)])
    low, high = np.log(DEPTHS).tolist()

    def directions(view: NDArray[np.int64], points: NDArray[np.float64]) -> NDArray[np.float64]:
        rays: NDArray[np.float64] = points - position[view]
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), np.finfo(float).tiny)
        return rays

    kept = np.zeros((0, 3))
    for _ in range(MOST_ROUNDS):
        view = random.integers(0, len(cameras), count)
        pixel = random.uniform(size=(count, 2)) * size[view]
        with np.errstate(all="ignore"):  # points behind a camera, or too far, are not kept
            depth = away[view, -1] * np.exp(random.uniform(low, high, count))
            ray = np.column_stack([(pixel - centre[view]) / focal[view], np.ones(count)])
            points = np.einsum("nji,nj->ni", rotation[view],
                               ray * depth[:, None] - translation[view])
            seen, own = np.zeros(count, bool), directions(view, points)
            for other in nearest[view].T:
                local = np.einsum("nij,nj->ni", rotation[other], points) + translation[other]
                pixel = local[:, :2] / local[:, 2:] * focal[other] + centre[other]
                inside = (local[:, 2] > 0) & ((pixel > 0) & (pixel < size[other])).all(axis=1)
                apart = np.linalg.norm(own - directions(other, points), axis=1)
                seen |= inside & (apart > LEAST_ANGLE)
            seen &= (np.abs(points) <= LARGEST_COORDINATE).all(axis=1)
        kept = np.concatenate([kept, points[seen]])
        if len(kept) >= count:
            break
    if len(kept) < FEWEST_POINTS:
        raise InputError(f"{path}: no points, and no two cameras see the same place from different "
                         "positions; put points3D.ply beside it, or reconstruct with COLMAP")
    return kept[:count]
