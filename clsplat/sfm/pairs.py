"""Which pairs of photos are matched, by what is known of the photos.

Matching all pairs takes a time that grows with the square of the number of photos. Where photos
have GPS, and are farther apart than its error, only neighbours can show the same; otherwise, the
largest features of all pairs are compared first, and only the most similar photos are matched with
all features.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pycolmap
import scipy
from numpy.typing import NDArray

from clsplat.constants import DESCRIPTOR_SIZE
from clsplat.device import Device
from clsplat.georeference import METRES_PER_DEGREE
from clsplat.sfm.features import image_id
from clsplat.sfm.match import Described, nearest
from clsplat.sfm.photos import SourcePhoto
from clsplat.sfm.progress import Progress

FEW_PHOTOS = 20  # so few are matched all with all: hardly more than with SIMILAR of them
LEAST_WITH_GPS = 0.9  # of the photos
LEAST_REACH = 10.0  # metres, the error of GPS: nearer positions do not show neighbours
NEIGHBOURS = 16  # nearest positions with which a photo is matched
BEFORE_AND_AFTER = 3  # photos by name with which a photo is matched
SEQUENCE = 10  # the same in a sequence of photos or frames
SIMILAR = 16  # most similar photos with which a photo is matched
LARGEST_FEATURES = 256  # of a photo, by which similarity is judged
COMPARED_AT_ONCE = 2048  # pairs


def choose_pairs(
    database: Path, photos: Sequence[SourcePhoto], method: str, device: Device, progress: Progress
) -> tuple[NDArray[np.int64], str]:
    """Choose pairs of photos.

    Parameters
    ----------
    database : with the features of the photos.
    method : auto, sequence or all.
    device : on which features are compared.

    Returns
    -------
    int[P, 2], indices of photos, the smaller one first; and why these, as text.
    """
    count = len(photos)
    if method == "all" or method == "auto" and count <= FEW_PHOTOS:
        rows = np.column_stack(np.triu_indices(count, 1))
        return rows, f"all {len(rows):,} pairs of {count} photos"
    with_gps = sum(photo.metadata.latitude is not None for photo in photos)
    if method == "auto" and with_gps >= LEAST_WITH_GPS * count:
        near, reach = _neighbours(photos)
        if reach >= LEAST_REACH:
            rows = _unique(near, count, BEFORE_AND_AFTER)
            return rows, (f"{len(rows):,} pairs of neighbours by GPS ({with_gps} of {count} photos have it)")
    reach, kind = (
        (SEQUENCE, "photos that follow each other or have similar content")
        if method == "sequence"
        else (BEFORE_AND_AFTER, "photos of similar content")
    )
    rows = _unique(list(_similar(database, count, device, progress)), count, reach)
    return rows, f"{len(rows):,} pairs of {kind}"


def _unique(pairs: list[tuple[int, int]], count: int, reach: int) -> NDArray[np.int64]:
    """These pairs, and each of `count` photos with the next `reach` ones; each pair once."""
    following = [
        (first, second) for first in range(count) for second in range(first + 1, min(first + 1 + reach, count))
    ]
    return np.unique(np.sort(np.array([*pairs, *following]), axis=1), axis=0)


def _neighbours(photos: Sequence[SourcePhoto]) -> tuple[list[tuple[int, int]], float]:
    """Each photo with GPS and its nearest ones; and how far these reach, in metres."""
    known = [row for row, photo in enumerate(photos) if photo.metadata.latitude is not None]
    degrees = np.array([(photos[row].metadata.longitude, photos[row].metadata.latitude) for row in known], np.float64)
    longitude, latitude = degrees[0]
    east = (degrees[:, 0] - longitude + 180) % 360 - 180  # also across the date line
    places = np.column_stack([east * np.cos(np.radians(latitude)), degrees[:, 1] - latitude]) * METRES_PER_DEGREE
    count = min(NEIGHBOURS + 1, len(known))
    distances, nearest = scipy.spatial.KDTree(places).query(places, [*range(1, count + 1)])
    return [
        (known[row], known[other]) for row, others in enumerate(nearest) for other in others if other != row
    ], float(np.median(distances[:, -1]))


def _similar(path: Path, count: int, device: Device, progress: Progress) -> Iterator[tuple[int, int]]:
    """Each photo with those that share most of its largest features."""
    with pycolmap.Database.open(path) as database:
        described = Described.of(
            device,
            [
                database.read_descriptors(image_id(index)).data[:LARGEST_FEATURES]
                if database.exists_descriptors(image_id(index))  # else the photo is damaged
                else np.empty((0, DESCRIPTOR_SIZE), np.uint8)
                for index in range(count)
            ],
        )
    rows = np.column_stack(np.triu_indices(count, 1))
    shared = np.zeros((count, count), np.int32)
    for begin in range(0, len(rows), COMPARED_AT_ONCE):
        progress.count("comparing pair", begin, len(rows))
        some = rows[begin : begin + COMPARED_AT_ONCE]
        first, second = some.T
        shared[first, second] = shared[second, first] = [
            len(matches) for matches in nearest(described, some, LARGEST_FEATURES)
        ]
    progress.count("comparing pair", len(rows), len(rows))
    for index, row in enumerate(shared):
        best = np.argsort(-row, kind="stable")[:SIMILAR]
        yield from ((index, int(other)) for other in best if row[other] > 0)
