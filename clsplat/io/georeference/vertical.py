"""What a user, the gimbals of cameras, or else cameras and points show of the vertical."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from clsplat.io.photos.metadata import PhotoMetadata
from clsplat.placement.up import Vertical, gimbal_up

LEAST_GIMBALS = 0.5  # share of the photos whose gimbals must be known


def vertical_of(
    images: Sequence[Any], points: NDArray[np.float64], metadata: Mapping[str, PhotoMetadata], given: ArrayLike | None
) -> Vertical:
    """What the user, the gimbals, or else the cameras and points show of the vertical."""
    if given is not None:
        return Vertical.measured(given)
    known = [metadata.get(image.name) for image in images]
    rotations = np.array([_upright(*pair) for pair in zip(images, known)])
    gimbals = [
        (rotation, photo.gimbal_pitch, photo.gimbal_roll)
        for rotation, photo in zip(rotations, known)
        if photo is not None
        and photo.orientation == 1
        and photo.gimbal_pitch is not None
        and photo.gimbal_roll is not None
    ]
    if gimbals and len(gimbals) >= LEAST_GIMBALS * len(images):
        by_gimbals = gimbal_up(*(np.array(values) for values in zip(*gimbals)))
        if by_gimbals is not None:
            return Vertical.measured(by_gimbals)
    return Vertical.by_cameras(rotations, points)


def _upright(image: Any, known: PhotoMetadata | None) -> NDArray[np.float64]:
    """The rotation float64[3, 3] from the world to the camera of the photo as EXIF turns it."""
    rotation: NDArray[np.float64] = image.cam_from_world().rotation.matrix()
    if known is None:
        return rotation
    # `clsplat sfm` turns pixels and camera itself, so the original's metadata no longer hold
    is_turned = (image.camera.width > image.camera.height) != (known.width > known.height)
    degrees = 0 if is_turned else 90 * known.quarter_turns
    turn: NDArray[np.float64] = scipy.spatial.transform.Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    return turn @ rotation
