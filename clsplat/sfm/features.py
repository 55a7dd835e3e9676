"""COLMAP's database of a reconstruction: cameras, photos and their SIFT features.

Photos are named by their number there.

Time and memory are those of one size of photo, whatever the camera's: large photos are made
smaller by area averaging, small ones are enlarged, up to SIFT's usual factor 2. Coordinates are
those of the photo as it is stored.
"""

import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.io.ahead import called_ahead
from clsplat.io.photos.images import read_image
from clsplat.io.photos.masks import read_mask
from clsplat.sfm.photos import SourceCamera, SourcePhoto
from clsplat.sfm.progress import Progress
from clsplat.sfm.sift import Sift

WORKING_SIZE = 1600  # long side in pixels of the image in which features are searched
LARGEST_FACTOR = 2.0


def image_id(index: int) -> int:
    """The id of a photo in the database, by its index."""
    return index + 1


def image_name(index: int) -> str:
    """The name of a photo in the database, by its index."""
    return f"{index:08d}"


def partners(path: Path) -> Counter[int]:
    """With how many photos each photo, by its id, shares features that two views can have."""
    with pycolmap.Database.open(path) as database:
        return Counter(
            number
            for pair, inliers in zip(*database.read_two_view_geometry_num_inliers())
            if inliers
            for number in pycolmap.pair_id_to_image_pair(pair)
        )


def create_database(path: Path, cameras: Sequence[SourceCamera]) -> None:
    """Create a database with cameras and photos; it appears whole or not at all."""
    partial = path.with_name(path.name + ".part")
    for left in path.parent.glob(partial.name + "*"):  # SQLite keeps two files beside it
        left.unlink()
    with pycolmap.Database.open(partial) as database:
        for number, source in enumerate(cameras, 1):
            database.write_camera(camera_of(number, source), use_camera_id=True)
            for index in source.photos:
                image = pycolmap.Image(name=image_name(index), camera_id=number)
                image.image_id = image_id(index)
                database.write_image(image, use_image_id=True)
    os.replace(partial, path)


def camera_of(number: int, source: SourceCamera) -> pycolmap.Camera:
    """The camera of the database with this id, as far as it is known."""
    camera = pycolmap.Camera.create_from_model_name(number, source.model, source.focal, source.width, source.height)
    camera.has_prior_focal_length = source.focal_known
    if source.calibration is not None:
        camera.params = list(source.calibration)
    return camera


def threads() -> int:
    """How many threads work at once: one a processor of this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


def extract_features(
    path: Path, photos: Sequence[SourcePhoto], device: Device, most: int, progress: Progress
) -> dict[str, str]:
    """Write the features of photos into a database, except those that it has already.

    Parameters
    ----------
    most : features of a photo; of more, the largest are kept.

    Returns
    -------
    The reasons, by name, why photos cannot be used: their pixels are damaged.
    """
    failures, sift = {}, Sift(device, most)
    with pycolmap.Database.open(path) as database:
        missing = [index for index in range(len(photos)) if not database.exists_descriptors(image_id(index))]
        decoded = called_ahead(_decoded, ((photos[index],) for index in missing), threads(), threads() + 1)
        for done, (index, found) in enumerate(zip(missing, decoded), len(photos) - len(missing)):
            progress.count("features of photo", done + 1, len(photos))
            if isinstance(found, str):
                failures[photos[index].name] = found
                continue
            descriptors = pycolmap.FeatureDescriptors()
            descriptors.type = pycolmap.FeatureExtractorType.SIFT
            keypoints, descriptors.data = _features(sift, photos[index], *found)
            with pycolmap.DatabaseTransaction(database):
                database.write_keypoints(image_id(index), keypoints)
                database.write_descriptors(image_id(index), descriptors)
    return failures


def _working_size(photo: SourcePhoto) -> tuple[int, int]:
    """Width and height of the image of a photo in which features are searched."""
    width, height = photo.metadata.width, photo.metadata.height
    factor = min(WORKING_SIZE / max(width, height), LARGEST_FACTOR)
    return max(1, round(width * factor)), max(1, round(height * factor))


def _decoded(photo: SourcePhoto) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None] | str:
    """The pixels of a photo, uint8[h, w, 3], no more than are needed, and its mask; or why there
    are none."""
    data, size = photo.metadata, _working_size(photo)
    try:
        pixels = read_image(photo.path, size if size[0] < data.width else None, levels=photo.levels)
        mask = None if photo.mask is None else read_mask(photo.mask, photo.mask, (data.width, data.height))
    except InputError as error:
        return str(error)
    return pixels, mask


def _features(
    sift: Sift, photo: SourcePhoto, pixels: NDArray[np.uint8], mask: NDArray[np.bool_] | None
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """float32[N, 4], x, y, scale and orientation, in pixels of the photo, and uint8[N, 128]."""
    size = _working_size(photo)
    keypoints, descriptors = sift.features(pixels, *size)
    factor = np.divide((photo.metadata.width, photo.metadata.height), size)
    keypoints[:, :2] *= factor
    keypoints[:, 2] *= factor.mean()
    if mask is not None:
        scale = np.divide(mask.shape[::-1], (photo.metadata.width, photo.metadata.height))
        x, y = np.clip(keypoints[:, :2] * scale, 0, np.subtract(mask.shape[::-1], 1)).astype(int).T
        keypoints, descriptors = keypoints[mask[y, x]], descriptors[mask[y, x]]
    return keypoints, descriptors
