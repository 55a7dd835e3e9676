"""Which pairs of photos are matched, by what is known of the photos.

Matching all pairs takes a time that grows with the square of the number of photos. Where photos
have GPS, and are farther apart than its error, only neighbours can show the same; otherwise, the
largest features of all pairs are compared first, and only the most similar photos are matched with
all features.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

from clsplat.errors import InputError
from clsplat.sfm.database import image_id
from clsplat.sfm.photos import SourcePhoto
from clsplat.sfm.progress import Progress

METHODS = ("auto", "gps", "sequence", "all")
FEW_PHOTOS = 20  # so few are matched all with all: hardly more than with SIMILAR of them
LEAST_WITH_GPS = 0.9  # of the photos
LEAST_REACH = 10.0  # metres, the error of GPS: nearer positions do not show neighbours
NEIGHBOURS = 16  # nearest positions with which a photo is matched
BEFORE_AND_AFTER = 3  # photos by name with which a photo is matched
SEQUENCE = 10  # the same in a sequence of photos or frames
SIMILAR = 16  # most similar photos with which a photo is matched
LARGEST_FEATURES = 256  # of a photo, by which similarity is judged
COMPARED_AT_ONCE = 32  # photos; products of small matrices cost more in threads than in arithmetic
MOST_RATIO = 0.85  # of the angles to the nearest and the second nearest descriptor
METRES_PER_DEGREE = 111_320.0


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs of photos to match, int[P, 2] with the smaller index first, and why these, as text."""

    rows: NDArray[np.int64]
    reason: str


def choose_pairs(database: Path, photos: Sequence[SourcePhoto], method: str, is_video: bool,
                 progress: Progress) -> Pairs:
    """Choose pairs of photos.

    Parameters
    ----------
    database : with the features of the photos.
    method : one of METHODS.
    is_video : whether the photos are frames of a video.

    Raises
    ------
    InputError : the method needs what the photos do not have.
    """
    count = len(photos)
    with_gps = sum(photo.metadata.latitude is not None for photo in photos)
    if method == "gps" and with_gps < LEAST_WITH_GPS * count:
        raise InputError(f"--matching gps: only {with_gps} of {count} photos have GPS; "
                         "leave the option out")
    if method == "all" or method == "auto" and count <= FEW_PHOTOS:
        rows = np.column_stack(np.triu_indices(count, 1))
        return Pairs(rows, f"all {len(rows):,} pairs of {count} photos")
    if method == "gps" or method == "auto" and with_gps >= LEAST_WITH_GPS * count and (
            reach_of(positions(photos)) >= LEAST_REACH):
        rows = _unique([*neighbours(positions(photos), NEIGHBOURS),
                        *sequence(count, BEFORE_AND_AFTER)])
        return Pairs(rows, f"{len(rows):,} pairs of neighbours by GPS ({with_gps} of {count} "
                           "photos have it)")
    is_sequence = is_video or method == "sequence"
    reach = SEQUENCE if is_sequence else BEFORE_AND_AFTER
    rows = _unique([*similar(database, count, progress), *sequence(count, reach)])
    kind = "photos that follow each other" if is_sequence else "photos of similar content"
    return Pairs(rows, f"{len(rows):,} pairs of {kind}"
                       f"{' or have similar content' if is_sequence else ''}")


def positions(photos: Sequence[SourcePhoto]) -> NDArray[np.float64]:
    """Positions float64[N, 2] to the east and the north of the first, metres; nan without GPS,
    which at least one photo has."""
    degrees = np.array([(photo.metadata.longitude, photo.metadata.latitude) for photo in photos],
                       np.float64)
    longitude, latitude = degrees[np.isfinite(degrees[:, 0])][0]
    east = (degrees[:, 0] - longitude + 180) % 360 - 180  # also across the date line
    return np.column_stack([east * np.cos(np.radians(latitude)), degrees[:, 1] - latitude]
                           ) * METRES_PER_DEGREE


def reach_of(places: ArrayLike) -> float:
    """How far the neighbours of most of the places float[N, 2] are from them, metres."""
    values = np.asarray(places, np.float64)
    known = values[np.isfinite(values).all(axis=1)]
    distances, _ = KDTree(known).query(known, min(NEIGHBOURS + 1, len(known)))
    return float(np.median(distances[:, -1]))


def neighbours(places: ArrayLike, count: int) -> Iterable[tuple[int, int]]:
    """Each of the places float[N, 2] with its nearest `count` ones; those of nan with none."""
    values = np.asarray(places, np.float64)
    known = np.flatnonzero(np.isfinite(values).all(axis=1))
    _, nearest = KDTree(values[known]).query(values[known], min(count + 1, len(known)))
    return ((int(known[row]), int(known[other])) for row, others in enumerate(
        nearest.reshape(len(known), -1)) for other in others if other != row)


def sequence(count: int, reach: int) -> Iterable[tuple[int, int]]:
    """Each of `count` photos with the next `reach` ones."""
    return ((first, second) for first in range(count)
            for second in range(first + 1, min(first + 1 + reach, count)))


def similar(database: Path, count: int, progress: Progress) -> Iterable[tuple[int, int]]:
    """Each photo with those that share most of its largest features."""
    descriptors = _largest(database, count)
    shared = np.zeros((count, count), np.int32)
    for first in range(count):
        progress.count("comparing photo", first + 1, count)
        for begin in range(first + 1, count, COMPARED_AT_ONCE):
            others = slice(begin, min(begin + COMPARED_AT_ONCE, count))
            shared[first, others] = shared[others, first] = shared_features(
                descriptors[first], descriptors[others])
    for index, row in enumerate(shared):
        best = np.argsort(-row, kind="stable")[:SIMILAR]
        yield from ((index, int(other)) for other in best if row[other] > 0)


def shared_features(first: NDArray[np.float32], others: NDArray[np.float32]) -> NDArray[np.int64]:
    """How many unit vectors are much nearer to one of another set than to the rest of that set.

    Parameters
    ----------
    first : [M, 128]; the vectors. Those that are zero count as none.
    others : [S, M, 128]; other sets.

    Returns
    -------
    int64[S].
    """
    sets, size, _ = others.shape
    cosines = (first @ others.reshape(sets * size, -1).T).reshape(len(first), sets, size)
    angles = np.arccos(np.clip(np.partition(cosines, -2, axis=2)[:, :, -2:], -1, 1))
    counts: NDArray[np.int64] = (angles[:, :, 1] < MOST_RATIO * angles[:, :, 0]).sum(axis=0)
    return counts


def _largest(database: Path, count: int) -> NDArray[np.float32]:
    """The descriptors of the largest features of each photo as unit vectors, [count,
    LARGEST_FEATURES, 128]; zero where a photo has fewer."""
    result = np.zeros((count, LARGEST_FEATURES, 128), np.float32)
    source = pycolmap.Database.open(database)
    try:
        for index in range(count):
            if not source.exists_descriptors(image_id(index)):  # the photo is damaged
                continue
            scales = source.read_keypoints(image_id(index))[:, 2]
            largest = np.argsort(-scales, kind="stable")[:LARGEST_FEATURES]
            values = source.read_descriptors(image_id(index)).data[largest].astype(np.float32)
            result[index, :len(values)] = values / np.maximum(
                np.linalg.norm(values, axis=1, keepdims=True), 1)
    finally:
        source.close()
    return result


def _unique(pairs: Iterable[tuple[int, int]]) -> NDArray[np.int64]:
    rows = sorted({(min(pair), max(pair)) for pair in pairs})
    return np.array(rows, np.int64).reshape(-1, 2)
