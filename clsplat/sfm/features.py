"""SIFT features of photos, on the CPU.

Time and memory are those of one size of photo, whatever the camera's: large photos are made
smaller by area averaging, small ones are enlarged, up to SIFT's usual factor 2. Coordinates are
those of the photo as it is stored.
"""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.io.ahead import called_ahead
from clsplat.io.photos.images import image_size, read_image
from clsplat.io.photos.masks import read_mask
from clsplat.sfm.database import image_id
from clsplat.sfm.photos import SourcePhoto
from clsplat.sfm.progress import Progress

WORKING_SIZE = 1600  # long side in pixels of the image in which features are searched
LARGEST_FACTOR = 2.0
MOST_FEATURES = 6144  # 4096 give too few points to start from: docs/evidence/photos.md
LUMINANCE = np.array([0.299, 0.587, 0.114], np.float32)


@dataclass(frozen=True, eq=False)
class Features:
    """The features of a photo: float32[N, 4], x, y, scale and orientation; uint8[N, 128]; or why
    the photo cannot be used."""

    keypoints: NDArray[np.float32]
    descriptors: NDArray[np.uint8]
    failure: str = ""


def extract_features(path: Path, photos: Sequence[SourcePhoto], progress: Progress,
                     most: int = MOST_FEATURES) -> dict[str, str]:
    """Write the features of photos into a database, except those that it has already.

    Parameters
    ----------
    path : of the database.
    most : features of a photo, of which the largest are kept.

    Returns
    -------
    The reasons, by name, why photos cannot be used: their pixels are damaged.
    """
    database = pycolmap.Database.open(path)
    try:
        missing = [index for index in range(len(photos))
                   if not database.exists_descriptors(image_id(index))]
        failures = {}
        done = len(photos) - len(missing)
        for index, found in _extracted(photos, missing, most):
            if found.failure:
                failures[photos[index].name] = found.failure
            else:
                _write(database, image_id(index), found)
            done += 1
            progress.count("features of photo", done, len(photos))
    finally:
        database.close()
    return failures


def _write(database: pycolmap.Database, number: int, found: Features) -> None:
    descriptors = pycolmap.FeatureDescriptors()
    descriptors.type = pycolmap.FeatureExtractorType.SIFT
    descriptors.data = found.descriptors
    with pycolmap.DatabaseTransaction(database):
        database.write_keypoints(number, found.keypoints)
        database.write_descriptors(number, descriptors)


def _extracted(photos: Sequence[SourcePhoto], indices: Sequence[int], most: int
               ) -> Iterator[tuple[int, Features]]:
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu, options.num_threads = False, 1
    options.sift.max_num_features, options.sift.first_octave = most, 0

    def one(index: int) -> tuple[int, Features]:
        # an extractor keeps buffers, so each photo has its own
        extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
        try:
            return index, _features(extractor, photos[index])
        except InputError as error:
            nothing = np.empty((0, 4), np.float32), np.empty((0, 128), np.uint8)
            return index, Features(*nothing, failure=str(error))

    # few at once, since a photo's features take half a megabyte
    yield from called_ahead(one, zip(indices), threads(), 2 * threads() + 1)


def threads() -> int:
    """How many threads work at once: one a processor of this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (
        os.cpu_count() or 1)


def _features(extractor: Any, photo: SourcePhoto) -> Features:
    width, height = image_size(photo.path)
    factor = min(WORKING_SIZE / max(width, height), LARGEST_FACTOR)
    size = max(1, round(width * factor)), max(1, round(height * factor))
    pixels = read_image(photo.path, size if factor < 1 else None, levels=photo.levels)
    bitmap = pycolmap.Bitmap.from_array((pixels @ LUMINANCE + 0.5).astype(np.uint8))
    if factor > 1:
        bitmap.rescale(*size)
    found, described = extractor.extract(bitmap)
    keypoints = np.array(pycolmap.keypoints_to_matrix(found), np.float32).reshape(-1, 4)
    keypoints[:, :2] *= width / size[0], height / size[1]
    keypoints[:, 2] /= factor
    descriptors = np.array(described.data, np.uint8).reshape(-1, 128)
    if photo.mask is not None:
        mask = read_mask(photo.mask, photo.mask, (width, height))
        scale = mask.shape[1] / width, mask.shape[0] / height
        x, y = np.clip(keypoints[:, :2] * scale, 0, np.subtract(mask.shape[::-1], 1)).astype(int).T
        keypoints, descriptors = keypoints[mask[y, x]], descriptors[mask[y, x]]
    return Features(keypoints, descriptors)
