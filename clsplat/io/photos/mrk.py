"""Positions in the files NAME_Timestamp.MRK that DJI's drones with RTK write beside their photos.

A line has the number of a photo, the time of GPS, the way from the antenna to the camera in
millimetres, the position of the camera, in which that way is contained, its standard deviations to
the north, to the east and up, metres, and how it was found:

    1 364521.123 [2100] -12,N 34,E 192,V 22.1,Lat 113.2,Lon 50.1,Ellh 0.01, 0.01, 0.03 50,Q
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from clsplat.georeference import METRES_PER_DEGREE
from clsplat.io.photos.metadata import RTK_FLOAT, PhotoMetadata
from clsplat.io.regular import read_regular

NUMBER = r"([-+]?\d+(?:\.\d+)?)"
LINE = re.compile(
    rf"\s*(\d{{1,9}})\s.*\s{NUMBER}\s*,\s*Lat\s+{NUMBER}\s*,\s*Lon\s+{NUMBER}\s*,\s*Ellh\s+"
    rf"{NUMBER}\s*,\s*{NUMBER}\s*,\s*{NUMBER}\s+(\d+)\s*,\s*Q"
)
NAME = re.compile(r"_(\d{4,5})(?:_[A-Z]+)?$")  # DJI_20230101120000_0001_V, 100_0034_0001, DJI_0001
NEAR = 30.0  # metres from EXIF's position; a position farther away is that of another flight


def with_mrk(photos: Iterable[tuple[Path, PhotoMetadata]]) -> tuple[list[PhotoMetadata], list[str]]:
    """The metadata of photos, with positions of the MRK files in their folders; and a note on each
    file that gives none.

    A position replaces that of the file if the number in the photo's name is that of the line, and
    it is at most NEAR from EXIF's, or the only one if EXIF has none. Lines that cannot be read are
    left out.
    """
    given, notes = list(photos), []
    marks: dict[Path, list[tuple[int, PhotoMetadata]]] = {}
    for folder in sorted({path.parent for path, _ in given}):
        marks[folder] = []
        for path in sorted(each for each in folder.iterdir() if each.suffix.lower() == ".mrk"):
            found = _read(path)
            marks[folder] += found
            if not found:
                notes.append(f"{path}: has no position that can be read, and is not used")
    result = [_nearest(path, known, marks[path.parent]) for path, known in given]
    count = sum(new is not old for new, (_, old) in zip(result, given))
    if count:
        notes.append(f"{count} of {len(given)} photos have a position of an MRK file")
    return result, notes


def _read(path: Path) -> list[tuple[int, PhotoMetadata]]:
    """Numbers of photos, and metadata of which only what is on the position counts."""
    result = []
    for match in map(LINE.match, read_regular(path).decode("utf-8", "replace").splitlines()):
        if match is not None and int(match[8]):  # 0: no position
            latitude, longitude, height, north, east, up = map(float, match.groups()[1:-1])
            is_rtk = int(match[8]) >= RTK_FLOAT and min(north, east, up) > 0
            std = (east, north, up) if is_rtk else None
            if abs(latitude) <= 90 and abs(longitude) <= 180:
                result.append(
                    (
                        int(match[1]),
                        PhotoMetadata(0, 0, latitude=latitude, longitude=longitude, altitude=height, gps_std=std),
                    )
                )
    return result


def _nearest(path: Path, known: PhotoMetadata, marks: Sequence[tuple[int, PhotoMetadata]]) -> PhotoMetadata:
    """The metadata of a photo with the position of the line that is its own, if there is one."""
    name = NAME.search(path.stem)
    found = [mark for number, mark in marks if name and number == int(name[1])]
    places = np.array([(mark.latitude, mark.longitude) for mark in found]).reshape(-1, 2)
    if known.latitude is not None and known.longitude is not None:
        away = METRES_PER_DEGREE * np.linalg.norm(
            (places - (known.latitude, known.longitude)) * (1, np.cos(np.radians(known.latitude))), axis=1
        )
        found = [found[row] for row in np.argsort(away)[:1] if away[row] <= NEAR]
    if len(found) != 1:
        return known
    mark = found[0]
    return replace(
        known,
        latitude=mark.latitude,
        longitude=mark.longitude,
        altitude=mark.altitude,
        above_ellipsoid=True,
        void=False,
        gps_std=mark.gps_std,
    )
