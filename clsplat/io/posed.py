"""Scenes of data sets that give the pose of every photo, with or without a point cloud."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.io.checks import ROTATION_TOLERANCE, checked_scene
from clsplat.io.cloud import Cloud, mean_colour, sample_points
from clsplat.io.sources import checked_photos
from clsplat.scene import Scene

# used until the cameras are checked, from which the points are then sampled
PLACEHOLDER_POINTS = np.array([(0.0, 0.0, 0.0), (1.0, 1.0, 1.0)])


@dataclass(frozen=True, eq=False)
class PosedPhoto:
    """A photo as a data set describes it.

    Attributes
    ----------
    size : (width, height), pixels.
    focal, centre : (x, y), pixels.
    pose : float64[3, 4], camera to world, with camera axes right, up, back (OpenGL).
    held_out : whether it is a test view.
    """

    name: str
    source: Path
    size: tuple[int, int]
    focal: tuple[float, float]
    centre: tuple[float, float]
    pose: NDArray[np.float64]
    held_out: bool = False


def posed_scene(path: Path, folder: Path, photos: Sequence[PosedPhoto], cloud: Cloud | None
                ) -> Scene:
    """Build the scene of a folder and recentre it; photos are checked as by `read_colmap`.

    Parameters
    ----------
    path : the file that messages name.
    cloud : points and perhaps colours; without it points are sampled where two cameras see, and a
        warning is logged.
    """
    rotations, translations = world_to_camera(np.array([photo.pose for photo in photos]))
    points, colours = cloud or (PLACEHOLDER_POINTS, None)
    scene = checked_scene(path, folder.resolve().name, {
        "names": np.array([photo.name for photo in photos], object), "rotations": rotations,
        "translations": translations, "focals": np.array([photo.focal for photo in photos]),
        "centres": np.array([photo.centre for photo in photos]),
        "sizes": np.array([photo.size for photo in photos]), "points": points,
        "colours": np.zeros((len(points), 3), np.uint8) if colours is None else colours,
    }, [photo.source for photo in photos])
    scene = checked_photos(scene)
    if cloud is None:
        scene = replace(scene, points=sample_points(path, scene.views))
        logging.getLogger(__name__).warning(
            "%s: no sparse points: %d are sampled at random where at least two cameras see; a "
            "model trained from points3D.ply or a COLMAP model beside it is better",
            path, len(scene.points))
    if colours is None:
        scene = replace(scene, colours=np.tile(mean_colour(scene.views), (len(scene.points), 1)))
    held_out = frozenset(photo.name for photo in photos if photo.held_out)
    return replace(scene, path=folder, held_out=held_out or None).recentred()


def world_to_camera(poses: NDArray[np.float64]
                    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Convert camera poses to rotations float64[V, 3, 3] and translations float64[V, 3].

    Files are rounded: an error of 1e-6 in a rotation would move a camera at UTM coordinates by
    metres. Nearly orthonormal matrices become the nearest rotation; others are left, and refused
    later.

    Parameters
    ----------
    poses : float64[V, 3, 4], as in `PosedPhoto`.
    """
    rotations = (poses[:, :, :3] * (1, -1, -1)).transpose(0, 2, 1)
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        almost = error <= ROTATION_TOLERANCE
        left, _, right = np.linalg.svd(rotations[almost])
        rotations[almost] = left @ right
        return rotations, -(rotations @ poses[:, :, 3:])[:, :, 0]
