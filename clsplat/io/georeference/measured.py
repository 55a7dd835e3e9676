"""Measured positions that a reconstruction may be placed by, and what they may be instead."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.io.georeference.adjustment import Located, NotGeoreferenced
from clsplat.io.georeference.crs import UTM_EPSG, heights_of, horizontal, outside
from clsplat.io.georeference.earth import map_positions
from clsplat.io.photos.metadata import PhotoMetadata
from clsplat.placement.alignment import LEAST_POSITIONS, Alignment
from clsplat.placement.plausible import Guess

UNKNOWN_STD = 3.0  # metres, of GPS that does not state it, among photos that do
UTM_LATITUDES = (-80.0, 84.0)  # degrees
FOOT = 0.3048
FARTHEST = 1000.0  # metres from the photos' GPS to where control points place them
ELLIPSOIDAL = "the photos' GPS altitudes, above the ellipsoid"
SEA_LEVEL = "the photos' GPS altitudes, nominally above sea level"
EXCHANGED = "are x and y exchanged, or has one of them the wrong sign?"


@dataclass(frozen=True, eq=False)
class Measured:
    """Positions of photos or of ground control points.

    Attributes
    ----------
    names : of the photos or points.
    places, positions : float64[N, 3], in the reconstruction, and map coordinates; nan for what is
        unknown.
    guesses : what the positions may be instead.
    crs : of the positions.
    vertical : what their heights count from.
    std : float64[N, 3], metres; None: all are equal.
    notes : lines for the user.
    """

    names: tuple[str, ...]
    places: NDArray[np.float64]
    positions: NDArray[np.float64]
    guesses: tuple[Guess, ...]
    crs: str
    vertical: str
    std: NDArray[np.float64] | None = None
    notes: tuple[str, ...] = ()


def by_control(located: Sequence[Located], lost: Sequence[str], crs: str, vertical: str
               ) -> Measured:
    """Ground control points; NotGeoreferenced if they are too few, or outside their CRS."""
    if len(located) < LEAST_POSITIONS:
        missing = f" (not located: {listed(lost)})" if lost else ""
        raise NotGeoreferenced(
            f"--gcp: {len(located)} of {len(located) + len(lost)} ground control points can be "
            f"located in the photos, and {LEAST_POSITIONS} are needed{missing}; mark each in two "
            "photos or more, by the names and in the pixels of the photos that were reconstructed")
    positions = np.array([item.point.position for item in located])
    degrees = (np.abs(positions[:, :2]) <= (180, 90)).all()
    where = outside(crs, positions) or (
        "within 200 m of the origin" if degrees and UTM_EPSG.fullmatch(crs) else "")
    exchanged = positions[:, [1, 0, 2]]
    if where:
        question = (": are they degrees? Then EPSG:4326 belongs into the first line" if degrees else
                    ": are x and y exchanged?" if not outside(crs, exchanged) else
                    ": is it the right CRS, and are they complete?")
        raise NotGeoreferenced(f"--gcp: the ground control points lie {where}, outside the area "
                               f"of {crs[:60]}{question}")
    return Measured(
        tuple(item.point.name for item in located), np.array([item.place for item in located]),
        positions, (Guess(EXCHANGED, exchanged),
                    Guess("are heights positive downwards?", positions * (1, 1, -1)),
                    Guess("are heights in feet?", positions * (1, 1, FOOT))), crs, vertical)


def by_gps(images: Sequence[Any], metadata: Mapping[str, PhotoMetadata], crs: str | None
           ) -> Measured:
    """Positions of photos; NotGeoreferenced if they are too few, or outside the CRS."""
    photos, centres, degrees = _gps(images, metadata)
    if len(photos) < LEAST_POSITIONS:
        raise NotGeoreferenced("no photo has GPS" if not photos else
                               f"only {len(photos)} photos have GPS", expected=True)
    known = [metadata[name] for name in photos]
    heights = np.array([photo.altitude for photo in known], np.float64)  # unknown: nan
    latitude, longitude = np.median(degrees, axis=0)
    if crs is None and not UTM_LATITUDES[0] <= latitude <= UTM_LATITUDES[1]:
        raise NotGeoreferenced(
            f"the photos' GPS is at latitude {latitude:.3f}, where UTM has no zones: are latitude "
            "and longitude exchanged? If not, give a CRS, "
            f'such as --crs "+proj=tmerc +lat_0={latitude:.0f} +lon_0={longitude:.0f} '
            '+datum=WGS84"')
    vertical = ELLIPSOIDAL if all(photo.above_ellipsoid for photo in known) else SEA_LEVEL
    notes = []
    if crs and heights_of(crs).name:
        notes.append(f"heights are not in {heights_of(crs).name}: they are {vertical}, and are not "
                     "converted")
        crs = horizontal(crs)
    positions, own = map_positions(degrees, heights, crs)
    if crs is not None:
        finite = positions[np.isfinite(positions[:, 0])]
        where = outside(own, finite) if len(finite) else "nowhere"
        if where:
            raise NotGeoreferenced(f"the photos' GPS lies {where}, outside the area of {own[:60]}; "
                                   "give another --crs, or leave it out")
    void = sum(photo.void for photo in known)
    if void:
        notes.append(f"the receiver marked the positions of {void} photos as void; they are used")
    std = None
    if any(photo.gps_std is not None for photo in known):
        std = np.array([photo.gps_std or 3 * (UNKNOWN_STD,) for photo in known])
    guesses = tuple(Guess(question, map_positions(other, heights)[0])
                    for question, other in _other_degrees(degrees))
    return Measured(tuple(photos), centres, positions, guesses, own, vertical, std, tuple(notes))


def _gps(images: Sequence[Any], metadata: Mapping[str, PhotoMetadata]
         ) -> tuple[list[str], NDArray[np.float64], NDArray[np.float64]]:
    """Of the images whose photos have GPS: names, centres [N, 3], latitudes and longitudes [N, 2].
    """
    found = [(image, metadata[image.name]) for image in images
             if image.name in metadata and metadata[image.name].latitude is not None]
    return ([image.name for image, _ in found],
            np.array([image.projection_center() for image, _ in found]).reshape(-1, 3),
            np.array([(known.latitude, known.longitude) for _, known in found],
                     np.float64).reshape(-1, 2))


def _other_degrees(degrees: NDArray[np.float64]) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """What latitudes and longitudes [N, 2] may be instead."""
    if (np.abs(degrees[:, 1]) <= 90).all():
        yield "are latitude and longitude exchanged?", degrees[:, ::-1]
    for column in (1, 0):
        for sign in (-1, 1):
            other = degrees.copy()
            other[:, column] = sign * np.abs(other[:, column])
            if not np.array_equal(other, degrees):
                yield "is the longitude (E, W) or the latitude (N, S) wrong in sign?", other


def require_near_gps(result: Alignment, images: Sequence[Any],
                     metadata: Mapping[str, PhotoMetadata], crs: str) -> None:
    """NotGeoreferenced if control points place the photos far from their own GPS."""
    names, centres, degrees = _gps(images, metadata)
    if len(names) < LEAST_POSITIONS:
        return
    gps, _ = map_positions(degrees, np.zeros(len(names)), horizontal(crs))
    away = np.linalg.norm((result.similarity(centres) - gps)[:, :2], axis=1)
    # what the CRS cannot represent is on the other side of the earth
    distance = float(np.median(np.nan_to_num(away, nan=2e7)))
    if distance > FARTHEST:
        raise NotGeoreferenced(
            f"--gcp: the ground control points place the photos {distance / 1000:.0f} km from "
            "their GPS: is it the right CRS, and are x and y exchanged?")


def listed(names: Sequence[str], shown: int = 5) -> str:
    """Some names, and how many others there are."""
    rest = len(names) - shown
    return ", ".join(names[:shown]) + (f" and {rest} others" if rest > 0 else "")
