"""Point clouds to start from, for data sets that bring poses but no sparse model."""

import numpy as np
from scipy.spatial import cKDTree

from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.io.checks import LARGEST
from clsplat.io.colmap import read_model
from clsplat.io.images import read_image
from clsplat.io.ply import read_vertices

PLY_NAMES = ("points3D.ply", "sparse_pc.ply")
COLOURS = ("red", "green", "blue")
# drawn points: so many a view, and in all
POINTS_A_VIEW, MOST_POINTS, FEWEST_POINTS = 500, 500_000, 100
ROUNDS = 8
NEIGHBOURS = 16  # views, the nearest ones, of which another must see a drawn point
DEPTHS = (0.5, 8.0)  # of drawn points, in distances to the farthest of those neighbours
LEAST_ANGLE = np.radians(1.0)  # between two views of a drawn point
PHOTOS, SMALL = 16, (32, 24)  # photos whose mean colour counts, and their size, pixels


def read_cloud(folder, named=None, turn=None):
    """(points float64[N, 3], colours uint8[N, 3] or None) of a scene folder, or None without any.

    named: path of a PLY, which must then be there. Else the first there is: points3D.ply,
    sparse_pc.ply, a COLMAP model in the folder or in colmap/, whose points p become turn @ (p, 1);
    turn: float64[3, 4], None: they stay.
    """
    for path in (folder / name for name in PLY_NAMES) if named is None else (named,):
        if named is not None or path.exists():
            return _ply_cloud(path)
    for place in (folder, folder / "colmap"):
        if (place / "sparse").is_dir():
            _, arrays = read_model(place)
            points = arrays["points"]
            if turn is not None:
                points = points @ turn[:, :3].T + turn[:, 3]
            return points, arrays["colours"]
    return None


def _ply_cloud(path):
    rows = read_vertices(path)[0].data
    kinds = {name: rows.dtype[name].kind for name in rows.dtype.names}
    if any(kinds.get(name, "") not in tuple("fiu") for name in "xyz"):
        raise InputError(f"{path}: its vertices have no x, y, z; give a PLY of points")
    points = np.stack([rows[name].astype(np.float64) for name in "xyz"], axis=1)
    if any(name not in kinds or rows.dtype[name] != np.uint8 for name in COLOURS):
        return points, None
    return points, np.stack([rows[name] for name in COLOURS], axis=1)


def draw_points(path, views):
    """float64[N, 3], world: random points in the volume that at least two of the views see.

    Each lies on the ray of a random pixel of a random view, at a depth drawn evenly in its
    logarithm from 0.5 to 8 times the distance to the 16th nearest view, and is kept where one of
    those 16 sees it too, from a direction at least a degree apart. The same views give the same
    points (seed 0). InputError, naming `path`, where hardly a point is kept.
    """
    random = np.random.default_rng(0)
    wanted = min(POINTS_A_VIEW * len(views), MOST_POINTS)
    stack = _Cameras([view.camera for view in views])
    kept = np.zeros((0, 3))
    for _ in range(ROUNDS):
        with np.errstate(all="ignore"):  # nothing behind a camera, or too far, is kept
            points, view = stack.drawn(random, wanted)
            seen = stack.seen_again(points, view) & (np.abs(points) <= LARGEST).all(axis=1)
        kept = np.concatenate([kept, points[seen]])
        if len(kept) >= wanted:
            break
    if len(kept) < FEWEST_POINTS:
        raise InputError(f"{path}: no points, and no two cameras look at the same place from "
                         "different ones; put points3D.ply beside it, or reconstruct with COLMAP")
    return kept[:wanted]


class _Cameras:
    """Many cameras as arrays, and the nearest neighbours of each."""

    def __init__(self, cameras: list[Camera]):
        self.rotation = np.array([c.rotation for c in cameras])
        self.translation = np.array([c.translation for c in cameras])
        self.focal = np.array([c.focal for c in cameras])
        self.centre = np.array([c.centre for c in cameras])
        self.size = np.array([(c.width, c.height) for c in cameras])
        self.position = np.array([c.position for c in cameras])
        count = min(NEIGHBOURS + 1, len(cameras))
        distance, nearest = cKDTree(self.position).query(self.position, k=count)
        self.away = distance.reshape(len(cameras), count)[:, -1]
        self.nearest = nearest.reshape(len(cameras), count)

    def drawn(self, random, count):
        """(points float64[count, 3], the view int[count] whose ray each is on)."""
        view = random.integers(0, len(self.size), count)
        pixel = random.uniform(size=(count, 2)) * self.size[view]
        depth = self.away[view] * np.exp(random.uniform(*np.log(DEPTHS), count))
        ray = np.column_stack([(pixel - self.centre[view]) / self.focal[view], np.ones(count)])
        local = ray * depth[:, None] - self.translation[view]
        return np.einsum("nji,nj->ni", self.rotation[view], local), view

    def seen_again(self, points, view):
        """bool[N]: whether a neighbour of its view sees a point, from another direction."""
        seen = np.zeros(len(points), bool)
        own = _directions(self.position[view], points)
        for other in self.nearest[view].T:
            local = np.einsum("nij,nj->ni", self.rotation[other], points) + self.translation[other]
            pixel = local[:, :2] / local[:, 2:] * self.focal[other] + self.centre[other]
            inside = (local[:, 2] > 0) & ((pixel > 0) & (pixel < self.size[other])).all(axis=1)
            apart = np.linalg.norm(own - _directions(self.position[other], points), axis=1)
            seen |= inside & (apart > LEAST_ANGLE)
        return seen


def _directions(begin, end):
    ray = end - begin
    return ray / np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), np.finfo(float).tiny)


def mean_colour(views):
    """uint8[3], the mean of at most 16 of the photos, evenly picked."""
    chosen = views[::-(-len(views) // PHOTOS)]
    mean = np.mean([read_image(view.source, SMALL).mean(axis=(0, 1)) for view in chosen], axis=0)
    return mean.round().astype(np.uint8)
