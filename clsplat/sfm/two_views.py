"""Matches of pairs of photos, and the geometry of their two views.

The largest features of two photos are compared first, all with all. What matches gives the geometry
of the two views, and then all features are compared that lie where it allows, which are few of all.
"""

import functools
import shutil
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pycolmap
from numpy.typing import NDArray

from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.sfm.features import image_id, threads
from clsplat.sfm.match import Described, follow, nearest
from clsplat.sfm.progress import Progress

FEW, MANY = 1024, 4096  # largest features that are compared all with all, MANY where FEW fail
FIRM, FIRM_GUESSED = 20, 150  # matches that agree and give an exact geometry; guessed focal lengths
FEWEST_MATCHES = 3  # of FEW, for which it is worth while to compare MANY
LEAST_FREE_BYTES = 1 << 26  # on the disk: more than the matches of so many pairs take
PAIRS_AT_ONCE = 64  # after which they are in the database, so that a killed command keeps them
PHOTOS_KEPT = 4 * PAIRS_AT_ONCE  # whose features are in memory, a megabyte each
PLANE_FACTOR = 10.0  # within so many errors of a place are enough others for the test of ratio
LEAST_RELIEF = 15  # matches away from a plane, by which the geometry of the two views is found
UNCALIBRATED = pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED
FAILED = (
    pycolmap.TwoViewGeometryConfiguration.UNDEFINED,
    pycolmap.TwoViewGeometryConfiguration.DEGENERATE,
    pycolmap.TwoViewGeometryConfiguration.WATERMARK,
)


class _Photo(NamedTuple):
    """Features of a photo: its camera, places float64[N, 2] in pixels, and directions [N, 2] as
    x / z and y / z, and descriptors uint8[N, 128]."""

    camera: pycolmap.Camera
    pixels: NDArray[np.float64]
    directions: NDArray[np.float64]
    descriptors: NDArray[np.uint8]


def match_pairs(path: Path, pairs: NDArray[np.int64], device: Device, progress: Progress) -> None:
    """Match pairs of photos, int[P, 2], and write matches and geometries into a database, except
    those that it has already. InputError if the disk is nearly full."""
    with pycolmap.Database.open(path) as database, ThreadPoolExecutor(threads()) as pool:
        missing = np.array(
            [
                pair
                for pair in pairs.tolist()
                if all(database.exists_descriptors(image_id(index)) for index in pair)
                and not database.exists_two_view_geometry(*map(image_id, pair))
            ]
        ).reshape(-1, 2)
        read = functools.lru_cache(PHOTOS_KEPT)(functools.partial(_read, database))
        done = len(pairs) - len(missing)
        for begin in range(0, len(missing), PAIRS_AT_ONCE):
            progress.count("matching pair", done + begin, len(pairs))
            if shutil.disk_usage(path.parent).free < LEAST_FREE_BYTES:
                raise InputError(
                    f"{path.parent}: the disk is nearly full; free some space, and "
                    "give the command again, which goes on from here"
                )
            batch = missing[begin : begin + PAIRS_AT_ONCE]
            numbers, rows = np.unique(batch, return_inverse=True)
            found = _matched(device, [read(number) for number in numbers.tolist()], rows.reshape(-1, 2), pool)
            with pycolmap.DatabaseTransaction(database):
                for (first, second), geometry in zip(batch.tolist(), found):
                    ids = image_id(first), image_id(second)
                    database.write_matches(*ids, geometry.inlier_matches)
                    database.write_two_view_geometry(*ids, geometry)
        progress.count("matching pair", len(pairs), len(pairs))


def _read(database: pycolmap.Database, index: int) -> _Photo:
    camera = database.read_camera(database.read_image(image_id(index)).camera_id)
    pixels = database.read_keypoints(image_id(index))[:, :2].astype(np.float64)
    return _Photo(
        camera,
        pixels,
        np.array(camera.cam_from_img(pixels)).reshape(-1, 2),
        database.read_descriptors(image_id(index)).data,
    )


def _matched(device: Device, photos: Sequence[_Photo], pairs: NDArray[np.intp], pool: ThreadPoolExecutor) -> list[Any]:
    """The geometry of each pair, int[P, 2] of these photos, with all its matches."""
    described = Described.of(device, [photo.descriptors for photo in photos])

    def estimate(most: int, rows: NDArray[np.intp]) -> list[tuple[int, Any]]:
        matches = nearest(described, pairs[rows], most)
        return list(
            zip(
                map(len, matches),
                pool.map(_geometry, *(map(photos.__getitem__, pairs[rows, side]) for side in (0, 1)), matches),
            )
        )

    found = estimate(FEW, np.arange(len(pairs)))
    firm = np.where(
        [[photos[number].camera.has_prior_focal_length for number in pair] for pair in pairs], FIRM, FIRM_GUESSED
    ).max(axis=1)
    again = [
        row
        for row, (matches, geometry) in enumerate(found)
        if matches >= FEWEST_MATCHES and len(geometry.inlier_matches) < firm[row]
    ]
    result = [geometry for _, geometry in found]
    for row, (_, geometry) in zip(again, estimate(MANY, np.array(again)) if again else []):
        if len(geometry.inlier_matches) > len(result[row].inlier_matches):
            result[row] = geometry
    rows = [row for row, geometry in enumerate(result) if geometry.config not in FAILED]
    if rows:
        room = described.descriptors.shape[1]
        places = np.zeros((len(photos), 2, room))
        for place, photo in zip(places, photos):
            place[:, : len(photo.directions)] = photo.directions.T
        allowed = np.array([_allowed(result[row], *map(photos.__getitem__, pairs[row])) for row in rows]).swapaxes(0, 1)
        found_there = follow(described, device.upload(places), pairs[rows], allowed)
        for row, matches, way in zip(rows, found_there, allowed[0]):
            first, second = (photos[number].directions for number in pairs[row])
            matches = matches[_agree(first[matches[:, 0]], second[matches[:, 1]], way)]
            if len(matches) > len(result[row].inlier_matches):
                result[row].inlier_matches = matches
    return result


def _options() -> pycolmap.TwoViewGeometryOptions:
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = 0
    return options


def _geometry(first: _Photo, second: _Photo, matches: NDArray[np.uint32]) -> Any:
    """A pycolmap.TwoViewGeometry."""
    geometry = pycolmap.estimate_two_view_geometry(
        first.camera, first.pixels, second.camera, second.pixels, matches, _options()
    )
    if geometry.config in FAILED:
        geometry.inlier_matches = np.empty((0, 2), np.uint32)
    elif geometry.E is None and geometry.F is None:
        _with_relief(geometry, first.pixels, second.pixels, matches)
    return geometry


def _with_relief(
    geometry: Any, first: NDArray[np.float64], second: NDArray[np.float64], matches: NDArray[np.uint32]
) -> None:
    """Let matches count that a plane does not explain, as those of roofs in photos of flat land:
    they alone show how far the cameras moved, and COLMAP drops them if they are fewer than a fifth.
    """
    found = pycolmap.estimate_fundamental_matrix(first[matches[:, 0]], second[matches[:, 1]], _options().ransac)
    if found is not None:
        inliers = matches[found["inlier_mask"]]
        if len(inliers) >= len(geometry.inlier_matches) + LEAST_RELIEF:
            geometry.config, geometry.F, geometry.inlier_matches = UNCALIBRATED, found["F"], inliers


def _allowed(geometry: Any, first: _Photo, second: _Photo) -> NDArray[np.float64]:
    """float64[2, 11], as for `follow`, among directions: from the first to the second photo, and
    back."""
    inner, outer = first.camera.calibration_matrix(), second.camera.calibration_matrix()
    error = 2 * _options().ransac.max_error / (inner[0, 0] + outer[0, 0])
    # with guessed focal lengths, an essential matrix is wrong
    known = geometry.E is not None and all(photo.camera.has_prior_focal_length for photo in (first, second))
    is_plane = not known and geometry.config != UNCALIBRATED
    if known:
        matrix = geometry.E
    elif is_plane:
        matrix = np.linalg.inv(outer) @ geometry.H @ inner
    else:
        matrix = outer.T @ geometry.F @ inner
    back = np.linalg.inv(matrix) if is_plane else matrix.T
    most = error * PLANE_FACTOR if is_plane else error
    return np.array([[*way.ravel(), is_plane, most] for way in (matrix, back)])


def _agree(first: NDArray[np.float64], second: NDArray[np.float64], way: NDArray[np.float64]) -> NDArray[np.bool_]:
    """bool[N], whether directions [N, 2] that were found by a row of `_allowed` fit it: by a plane,
    more were compared than fit."""
    if not way[9]:
        return np.ones(len(first), bool)
    there = np.column_stack([first, np.ones(len(first))]) @ way[:9].reshape(3, 3).T
    away = np.linalg.norm(there[:, :2] / there[:, 2:] - second, axis=1)
    return np.asarray(away <= way[10] / PLANE_FACTOR)
