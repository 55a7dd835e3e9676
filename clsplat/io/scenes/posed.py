"""Scenes of data sets and projects that give the pose of every photo, with points or without.

A reader translates cameras to COLMAP's models and axes, exactly or not at all; the scene then is
built as that of a COLMAP model is.
"""

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.georeference import Georeference
from clsplat.io.fields import LARGEST_COORDINATE
from clsplat.io.models.ply import read_vertices
from clsplat.io.models.points import GREY, ply_points
from clsplat.io.photos.lenses import Model, undistorted_model
from clsplat.io.scenes.checks import ROTATION_TOLERANCE, checked_scene
from clsplat.io.scenes.colmap import read_model
from clsplat.io.scenes.sources import checked_photos
from clsplat.scene import Scene, View

COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")  # as files name them
# those of COLMAP's camera models, after focal length and centre: factors of r^2, r^4, ... (k), of
# tangential distortion (p), and of the polynomial that divides (d)
TERMS = {
    "PINHOLE": "",
    "OPENCV": "k1 k2 p1 p2",
    "FULL_OPENCV": "k1 k2 p1 p2 k3 d1 d2 d3",
    "OPENCV_FISHEYE": "k1 k2 k3 k4",
    "THIN_PRISM_FISHEYE": "k1 k2 p1 p2 k3 k4 s1 s2",
}
BROWN = ("PINHOLE", "OPENCV", "FULL_OPENCV")
FISHEYE = ("OPENCV_FISHEYE",)
FLIPPED = np.array([1.0, -1.0, -1.0])  # camera axes right, up, back to right, down, forward
PLY_NAMES = ("points3D.ply", "sparse_pc.ply")
# sampled points: a view, and in all
POINTS_A_VIEW, MOST_POINTS, FEWEST_POINTS = 500, 500_000, 100
TRIES_A_POINT = 8
NEIGHBOURS = 16  # nearest views, of which one more must see a sampled point
DEPTHS = (0.5, 8.0)  # of sampled points, in distances to the farthest of those neighbours
LEAST_BASE = np.radians(1.0)  # distance of two views of a sampled point, as a share of its depth


class Cloud(NamedTuple):
    """The sparse points of a data set or a project: float64[N, 3], world, and uint8[N, 3]; and in
    which photos they are, int[M, 2], rows (point, photo), if that is known."""

    positions: NDArray[np.float64]
    colours: NDArray[np.uint8]
    observations: NDArray[np.int64] | None = None


@dataclass(frozen=True)
class Optics:
    """The camera model of a photo: size, focal length and centre in pixels as in COLMAP, where (0,
    0) is the outer corner of the first; `model` is None for a pinhole camera."""

    size: tuple[int, int]
    focal: tuple[float, float]
    centre: tuple[float, float]
    model: Model | None = None


def optics(
    size: tuple[int, int],
    focal: tuple[float, float],
    centre: tuple[float, float],
    models: Sequence[str],
    values: Mapping[str, float],
) -> Optics:
    """The camera with the first of some models (BROWN, FISHEYE) that has all its coefficients.

    Parameters
    ----------
    values : coefficients by the names of TERMS; p1 is OpenCV's, the factor of 2 x y in x.
    """
    used = [key for key, value in values.items() if value]
    for model in models:
        terms = TERMS[model].split()
        if set(used) <= set(terms):
            parameters = (*focal, *centre, *(values.get(term, 0.0) for term in terms))
            return Optics(size, focal, centre, (model, parameters) if terms else None)
    other = next(key for key in used if key not in terms)
    raise ValueError(
        f"no camera model of COLMAP has its coefficient {other}; optimise the cameras "
        "without it, or export undistorted photos"
    )


@dataclass(frozen=True, eq=False)
class PosedPhoto:
    """A photo as a data set or a project describes it."""

    # name, source: of the view, and its file
    name: str
    source: Path
    optics: Optics  # its camera model
    # float64[3, 3], world to camera (right, down, forward); nearly a rotation, as far as files are
    # rounded
    rotation: NDArray[np.float64]
    position: NDArray[np.float64]  # float64[3], the optical centre, world
    held_out: bool = False  # whether it is a test view
    mask: Path | None = None  # an image of which pixels count


def posed_scene(
    path: Path,
    folder: Path,
    photos: Sequence[PosedPhoto],
    cloud: Cloud | None,
    *,
    smaller: Path | None = None,
    georeference: Georeference | None = None,
    z_is_up: bool = False,
    notes: Iterable[str] = (),
) -> Scene:
    """Build the scene of a folder and recentre it; photos are checked as by `read_colmap`.

    Parameters
    ----------
    path : the file that messages name.
    cloud : the points; None: they are sampled where two cameras see, and a warning is logged.
    smaller : as for `checked_photos`.
    """
    rotations, translations = exact_poses(
        np.array([photo.rotation for photo in photos]), np.array([photo.position for photo in photos])
    )
    optics = [photo.optics for photo in photos]
    arrays = {
        "names": np.array([photo.name for photo in photos], object),
        "rotations": rotations,
        "translations": translations,
        "focals": np.array([each.focal for each in optics]),
        "centres": np.array([each.centre for each in optics]),
        "sizes": np.array([each.size for each in optics]),
    }
    if cloud is not None:
        arrays |= {"points": cloud.positions, "colours": cloud.colours}
        if cloud.observations is not None:
            arrays["observations"] = cloud.observations
    arrays = undistorted_model(path, arrays, [each.model for each in optics])
    by_name = {photo.name: photo for photo in photos}
    used = [by_name[name] for name in arrays["files"]]
    scene = checked_scene(path, folder.resolve().name, arrays, [photo.source for photo in used])
    by_view = dict(zip(map(str, arrays["names"]), used))
    scene = checked_photos(
        replace(
            scene,
            notes=tuple(notes),
            georeference=georeference,
            given_up=np.array([0.0, 0.0, 1.0]) if z_is_up else None,
            held_out=frozenset(name for name, photo in by_view.items() if photo.held_out) or None,
            views=tuple(replace(view, mask=by_view[view.name].mask) for view in scene.views),
        ),
        smaller,
    )
    if cloud is None:
        points = sample_points(path, scene.views)
        scene = replace(scene, points=points, colours=np.full(points.shape, GREY, np.uint8))
        logging.getLogger(__name__).warning(
            "%s: no sparse points: %d are sampled at random where at least two cameras see; a "
            "model trained from points3D.ply beside it, a COLMAP model or --init FILE (a point "
            "cloud) is better",
            path,
            len(scene.points),
        )
    return scene.recentred()


def exact_poses(
    rotations: NDArray[np.float64], positions: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotations float64[V, 3, 3] and translations float64[V, 3] of cameras, world to camera, of
    their rotations as files have them and their positions float64[V, 3].

    Files are rounded: an error of 1e-6 in a rotation would move a camera at UTM coordinates by
    metres. Nearly orthonormal matrices become the nearest rotation; others are refused later.
    """
    exact = rotations.copy()
    with np.errstate(all="ignore"):
        error = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        almost = error <= ROTATION_TOLERANCE
        left, _, right = np.linalg.svd(rotations[almost])
        exact[almost] = left @ right
        return exact, -(exact @ positions[:, :, None])[:, :, 0]


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
            return Cloud(arrays["points"] @ transform[:, :3].T + transform[:, 3], arrays["colours"])
    return None


def _ply_cloud(path: Path) -> Cloud:
    points, colours = ply_points(path, read_vertices(path)[0])
    if colours is None or colours.dtype != np.uint8:
        colours = np.full(points.shape, GREY, np.uint8)
    return Cloud(points, colours)


def sample_points(path: Path, views: Sequence[View]) -> NDArray[np.float64]:
    """Sample random points, float64[N, 3], in the volume that at least two of the views see.

    Each point lies on the ray of a random pixel of a view, at a depth whose logarithm is uniform
    from 0.5 to 8 times the distance to the 16th nearest view, and is kept if one of those 16 views
    sees it too, about a degree apart or more. The same views give the same points (seed 0).
    InputError, which names the path, if hardly a point is kept.
    """
    random = np.random.default_rng(0)
    cameras = [view.camera for view in views]
    positions = np.array([camera.position for camera in cameras])
    most = min(POINTS_A_VIEW, max(1, MOST_POINTS // len(cameras)))
    away, nearest = scipy.spatial.cKDTree(positions).query(
        positions, [*range(1, min(NEIGHBOURS + 1, len(cameras)) + 1)]
    )
    kept, (low, high), count = [], np.log(DEPTHS), TRIES_A_POINT * most
    for camera, distances, others in zip(cameras, away, nearest):
        pixels = random.uniform((0, 0), (camera.width, camera.height), (count, 2))
        with np.errstate(all="ignore"):  # points behind a camera, or too far, are not kept
            depths = distances[-1] * np.exp(random.uniform(low, high, count))
            rays = np.column_stack([(pixels - camera.centre) / camera.focal, np.ones(count)])
            points = (rays * depths[:, None] - camera.translation) @ camera.rotation
            seen = np.any(
                [
                    cameras[other].shows(points) & (distance > LEAST_BASE * depths)
                    for distance, other in zip(distances, others)
                ],
                axis=0,
            )
            seen &= (np.abs(points) <= LARGEST_COORDINATE).all(axis=1)
        kept.append(points[seen][:most])
    sampled = np.concatenate(kept)
    if len(sampled) < FEWEST_POINTS:
        raise InputError(
            f"{path}: no points, and no two cameras see the same place from different "
            "positions; put points3D.ply beside it, or reconstruct with COLMAP"
        )
    return sampled
