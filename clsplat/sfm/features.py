"""COLMAP's database of a reconstruction: cameras and photos, SIFT features and matches, on the CPU.

Photos are named by their number there, since COLMAP's lists of pairs are separated by spaces.

Time and memory are those of one size of photo, whatever the camera's: large photos are made
smaller by area averaging, small ones are enlarged, up to SIFT's usual factor 2. Coordinates are
those of the photo as it is stored.
"""

import os
import shutil
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.io.ahead import called_ahead
from clsplat.io.photos.images import read_image
from clsplat.io.photos.masks import read_mask
from clsplat.sfm.photos import SourceCamera, SourcePhoto
from clsplat.sfm.progress import Progress

WORKING_SIZE = 1600  # long side in pixels of the image in which features are searched
LARGEST_FACTOR = 2.0
MOST_FEATURES = 6144  # 4096 give too few points to start from: docs/evidence/photos.md
LUMINANCE = np.array([0.299, 0.587, 0.114], np.float32)
LEAST_FREE_BYTES = 1 << 26  # on the disk: more than the matches of so many pairs take
PAIRS_AT_ONCE = 64  # after which they are in the database, so that a killed command keeps them


def image_id(index: int) -> int:
    """The id of a photo in the database, by its index."""
    return index + 1


def image_name(index: int) -> str:
    """The name of a photo in the database, by its index."""
    return f"{index:08d}"


def partners(path: Path) -> Counter[int]:
    """With how many photos each photo, by its id, shares features that two views can have."""
    with pycolmap.Database.open(path) as database:
        return Counter(number for pair, inliers in zip(
            *database.read_two_view_geometry_num_inliers()) if inliers
            for number in pycolmap.pair_id_to_image_pair(pair))


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
    camera = pycolmap.Camera.create_from_model_name(
        number, source.model, source.focal, source.width, source.height)
    camera.has_prior_focal_length = source.focal_known
    if source.calibration is not None:
        camera.params = list(source.calibration)
    return camera


def threads() -> int:
    """How many threads work at once: one a processor of this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (
        os.cpu_count() or 1)


def extract_features(path: Path, photos: Sequence[SourcePhoto], progress: Progress
                     ) -> dict[str, str]:
    """Write the features of photos into a database, except those that it has already; the reasons,
    by name, why photos cannot be used: their pixels are damaged."""
    failures = {}
    with pycolmap.Database.open(path) as database:
        missing = [index for index in range(len(photos))
                   if not database.exists_descriptors(image_id(index))]
        # few at once, since a photo's features take half a megabyte
        found = called_ahead(_features, ((photos[index],) for index in missing), threads(),
                             2 * threads() + 1)
        for done, (index, features) in enumerate(zip(missing, found), len(photos) - len(missing)):
            progress.count("features of photo", done + 1, len(photos))
            if isinstance(features, str):
                failures[photos[index].name] = features
                continue
            descriptors = pycolmap.FeatureDescriptors()
            descriptors.type = pycolmap.FeatureExtractorType.SIFT
            keypoints, descriptors.data = features
            with pycolmap.DatabaseTransaction(database):
                database.write_keypoints(image_id(index), keypoints)
                database.write_descriptors(image_id(index), descriptors)
    return failures


def _features(photo: SourcePhoto) -> tuple[NDArray[np.float32], NDArray[np.uint8]] | str:
    """float32[N, 4], x, y, scale and orientation, and uint8[N, 128]; or why there are none."""
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu, options.num_threads = False, 1
    options.sift.max_num_features, options.sift.first_octave = MOST_FEATURES, 0
    width, height = photo.metadata.width, photo.metadata.height
    factor = min(WORKING_SIZE / max(width, height), LARGEST_FACTOR)
    size = max(1, round(width * factor)), max(1, round(height * factor))
    try:
        pixels = read_image(photo.path, size if factor < 1 else None, levels=photo.levels)
        mask = None if photo.mask is None else read_mask(photo.mask, photo.mask, (width, height))
    except InputError as error:
        return str(error)
    bitmap = pycolmap.Bitmap.from_array((pixels @ LUMINANCE + 0.5).astype(np.uint8))
    if factor > 1:
        bitmap.rescale(*size)
    # an extractor keeps buffers, so each photo has its own
    extractor: Any = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
    found, described = extractor.extract(bitmap)
    keypoints = np.array(pycolmap.keypoints_to_matrix(found), np.float32).reshape(-1, 4)
    keypoints[:, :2] *= width / size[0], height / size[1]
    keypoints[:, 2] /= factor
    descriptors = np.array(described.data, np.uint8).reshape(-1, 128)
    if mask is not None:
        scale = mask.shape[1] / width, mask.shape[0] / height
        x, y = np.clip(keypoints[:, :2] * scale, 0, np.subtract(mask.shape[::-1], 1)).astype(int).T
        keypoints, descriptors = keypoints[mask[y, x]], descriptors[mask[y, x]]
    return keypoints, descriptors


def match_pairs(path: Path, pairs: NDArray[np.int64], progress: Progress) -> None:
    """Match pairs of photos, int[P, 2], and check them by the geometry of two views, except those
    that the database, whose folder gets a temporary list, has already.

    InputError if the disk is nearly full, in which case pycolmap would end the process.
    """
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu, options.num_threads = False, threads()
    geometry = pycolmap.TwoViewGeometryOptions()
    geometry.ransac.random_seed = 0
    listed = pycolmap.ImportedPairingOptions()
    listed.match_list_path = path.with_name("pairs.txt")
    with pycolmap.Database.open(path) as database:
        missing = [pair for pair in pairs.tolist()
                   if all(database.exists_descriptors(image_id(index)) for index in pair)
                   and not database.exists_two_view_geometry(*map(image_id, pair))]
    done = len(pairs) - len(missing)
    for begin in range(0, len(missing), PAIRS_AT_ONCE):
        progress.count("matching pair", done + begin, len(pairs))
        if shutil.disk_usage(path.parent).free < LEAST_FREE_BYTES:
            raise InputError(f"{path.parent}: the disk is nearly full; free some space, and give "
                             "the command again, which goes on from here")
        listed.match_list_path.write_text("".join(
            f"{image_name(first)} {image_name(second)}\n"
            for first, second in missing[begin:begin + PAIRS_AT_ONCE]), "utf-8")
        pycolmap.match_image_pairs(path, options, listed, geometry, pycolmap.Device.cpu)
    progress.count("matching pair", len(pairs), len(pairs))
