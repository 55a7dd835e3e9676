"""Whether the lenses that a reconstruction found can be true."""

from collections.abc import Sequence

import numpy as np
import pycolmap

from clsplat.sfm.photos import SourceCamera

MOST_FOCAL = 0.15  # of the focal length by which it may differ from what photos state
MOST_CENTRE = 0.05  # of the longer side, between the principal point and the middle
MOST_DISTORTED = 0.3  # of the distance from the middle
STEPS = 32  # places from the middle to a corner
CURE = "; add photos from other heights and in other directions, or give another --camera-model"


def lens_doubts(model: pycolmap.Reconstruction, cameras: Sequence[SourceCamera]) -> list[str]:
    """A sentence for each value of a lens that cannot be true; `cameras` as they were known before,
    by whose order the model numbers its own."""
    return [
        f"camera {number} ({len(source.photos)} photos of {source.width}x{source.height}): {doubt}{CURE}"
        for number, source in enumerate(cameras, 1)
        if number in model.cameras
        for doubt in _doubts(model.cameras[number], source)
    ]


def _doubts(camera: pycolmap.Camera, source: SourceCamera) -> list[str]:
    found, size = [], np.array([camera.width, camera.height])
    focals = np.array([camera.focal_length_x, camera.focal_length_y])
    centre = np.array([camera.principal_point_x, camera.principal_point_y])
    share = focals.mean() / source.focal - 1
    if source.focal_known and abs(share) > MOST_FOCAL:
        found.append(
            f"the focal length of {focals.mean():.0f} pixels is {100 * share:+.0f} % from "
            f"the {source.focal:.0f} of the photos' metadata"
        )
    away = np.linalg.norm(centre - (source.calibration[2:4] if source.calibration else size / 2))
    if away > MOST_CENTRE * size.max():
        found.append(f"the principal point is {away:.0f} pixels from where it is expected")
    corner = np.where(centre < size / 2, size, 0) - centre  # the farthest one
    straight = np.linspace(0, 1, STEPS + 1)[1:, None] * corner
    rays = np.hstack([straight / focals, np.ones((STEPS, 1))])
    distances = np.linalg.norm(camera.img_from_cam(rays) - centre, axis=1)
    moved = distances[-1] / np.linalg.norm(corner) - 1
    if not (np.diff(distances) > 0).all():
        found.append("its distortion folds the corners of the photos inwards")
    elif abs(moved) > MOST_DISTORTED and "FISHEYE" not in camera.model_name:
        found.append(f"its distortion moves the corners of the photos by {100 * moved:+.0f} %")
    return found
