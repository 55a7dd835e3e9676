"""Scenes of data sets that give the pose of every photo, with or without a point cloud."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.io.photos.lenses import Model, undistorted_model
from clsplat.io.scenes.checks import ROTATION_TOLERANCE, checked_scene
from clsplat.io.scenes.cloud import Cloud, mean_colour, sample_points
from clsplat.io.scenes.sources import checked_photos
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
    lens : the camera model of the photo, if it is not a pinhole's.
    mask : an image of which pixels count.
    """

    name: str
    source: Path
    size: tuple[int, int]
    focal: tuple[float, float]
    centre: tuple[float, float]
    pose: NDArray[np.float64]
    held_out: bool = False
    lens: Model | None = None
    mask: Path | None = None


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
    arrays = undistorted_model(path, {
        "names": np.array([photo.name for photo in photos], object), "rotations": rotations,
        "translations": translations, "focals": np.array([photo.focal for photo in photos]),
        "centres": np.array([photo.centre for photo in photos]),
        "sizes": np.array([photo.size for photo in photos]), "points": points,
        "colours": np.zeros((len(points), 3), np.uint8) if colours is None else colours,
    }, [photo.lens for photo in photos])
    known = {photo.name: photo for photo in photos}
    used = [known[name] for name in arrays["files"]]
    scene = checked_scene(path, folder.resolve().name, arrays, [photo.source for photo in used])
    masks = {name: photo.mask for name, photo in zip(arrays["names"], used)}
    scene = checked_photos(replace(scene, views=tuple(
        replace(view, mask=masks[view.name]) for view in scene.views)))
    scene = with_points(path, scene, cloud is None, colours is None)
    held_out = frozenset(str(name) for name, photo in zip(arrays["names"], used) if photo.held_out)
    return replace(scene, path=folder, held_out=held_out or None).recentred()


def with_points(path: Path, scene: Scene, no_points: bool, no_colours: bool) -> Scene:
    """The scene with what its data set lacks: random points where two cameras see, with a warning,
    and the mean colour of its photos.

    Parameters
    ----------
    path : the file that messages name.
    no_points, no_colours : whether the points, or their colours, are missing.
    """
    if no_points:
        scene = replace(scene, points=sample_points(path, scene.views))
        logging.getLogger(__name__).warning(
            "%s: no sparse points: %d are sampled at random where at least two cameras see; a "
            "model trained from points3D.ply beside it, a COLMAP model or --init FILE (a point "
            "cloud) is better",
            path, len(scene.points))
    if no_colours:
        scene = replace(scene, colours=np.tile(mean_colour(scene.views), (len(scene.points), 1)))
    return scene


def world_to_camera(poses: NDArray[np.float64]
                    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Convert camera poses to rotations float64[V, 3, 3] and translations float64[V, 3].

    Parameters
    ----------
    poses : float64[V, 3, 4], as in `PosedPhoto`.
    """
    return exact_poses((poses[:, :, :3] * (1, -1, -1)).transpose(0, 2, 1), poses[:, :, 3])


def exact_poses(rotations: NDArray[np.float64], positions: NDArray[np.float64]
                ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotations float64[V, 3, 3] and translations float64[V, 3] of cameras.

    Files are rounded: an error of 1e-6 in a rotation would move a camera at UTM coordinates by
    metres. Nearly orthonormal matrices become the nearest rotation; others are left, and refused
    later.

    Parameters
    ----------
    rotations : float64[V, 3, 3], world to camera.
    positions : float64[V, 3], the optical centres, world.
    """
    exact = rotations.copy()
    with np.errstate(all="ignore"):
        error = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        almost = error <= ROTATION_TOLERANCE
        left, _, right = np.linalg.svd(rotations[almost])
        exact[almost] = left @ right
        return exact, -(exact @ positions[:, :, None])[:, :, 0]
