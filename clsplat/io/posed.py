"""Scenes of data sets that give every photo's pose, with a point cloud or without."""

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from clsplat.io.checks import ROTATION_TOLERANCE, checked_scene
from clsplat.io.cloud import draw_points, mean_colour
from clsplat.io.sources import checked_photos

# stand for the points until the cameras they are drawn from are known to be right
UNKNOWN = np.array([(0.0, 0.0, 0.0), (1.0, 1.0, 1.0)])


@dataclass(frozen=True, eq=False)
class PosedPhoto:
    """A photo as a data set describes it.

    pose: float64[3, 4], camera to world, camera axes right, up, back (OpenGL). size: (width,
    height), focal and centre, pixels. held_out: it is for testing.
    """

    name: str
    source: Path
    size: tuple[int, int]
    focal: tuple[float, float]
    centre: tuple[float, float]
    pose: np.ndarray
    held_out: bool = False


def posed_scene(path, folder, shots, cloud):
    """The recentred scene of a folder; every photo is checked, as `read_colmap` does.

    path: the file that messages name; shots: list of PosedPhoto; cloud: `cloud.read_cloud`'s points
    and colours, or None: then points are drawn where two cameras look, and a warning is logged.
    """
    rotations, translations = world_to_camera(np.array([shot.pose for shot in shots]))
    points, colours = cloud or (UNKNOWN, None)
    if colours is None:
        colours = np.zeros((len(points), 3), np.uint8)
    scene = checked_scene(path, folder.resolve().name, {
        "names": np.array([shot.name for shot in shots], object), "rotations": rotations,
        "translations": translations, "focals": np.array([shot.focal for shot in shots]),
        "centres": np.array([shot.centre for shot in shots]),
        "sizes": np.array([shot.size for shot in shots]), "points": points, "colours": colours,
    }, [shot.source for shot in shots])
    scene = checked_photos(scene)
    if cloud is None:
        scene = replace(scene, points=draw_points(path, scene.views))
        logging.getLogger(__name__).warning(
            "%s: no sparse points: %d are drawn at random where two cameras look; a model trained "
            "from points3D.ply or a COLMAP model beside it is better", path, len(scene.points))
    if cloud is None or cloud[1] is None:
        scene = replace(scene, colours=np.tile(mean_colour(scene.views), (len(scene.points), 1)))
    held_out = frozenset(shot.name for shot in shots if shot.held_out)
    return replace(scene, path=folder, held_out=held_out or None).recentred()


def world_to_camera(poses):
    """Rotations float64[V, 3, 3] and translations float64[V, 3] of `clsplat.camera`, of poses
    float64[V, 3, 4] as `PosedPhoto` has them.

    Files round: an error of 1e-6 in a rotation would move a camera at UTM coordinates by metres.
    What is almost a rotation becomes the nearest one; what is none stays, to be refused.
    """
    rotations = (poses[:, :, :3] * (1, -1, -1)).transpose(0, 2, 1)
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        almost = error <= ROTATION_TOLERANCE
        left, _, right = np.linalg.svd(rotations[almost])
        rotations[almost] = left @ right
        return rotations, -(rotations @ poses[:, :, 3:])[:, :, 0]
