"""Reads ground control points: places with known coordinates that were marked in photos.

docs/guide/georeference.md has the format.
"""

import csv
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError, clean
from clsplat.io.fields import parsed, reading
from clsplat.io.georeference import crs as systems
from clsplat.io.georeference.crs import heights_of, horizontal, on_ground
from clsplat.io.regular import read_regular

NUMBERS = ("x", "y", "z", "pixel_x", "pixel_y")
COLUMNS = (*NUMBERS, "image", "name")  # of a file without a header
LONGEST_HEADER = 1000  # characters
OF_WEBODM = {
    "geo_x": "x",
    "geo_y": "y",
    "geo_z": "z",
    "im_x": "pixel_x",
    "im_y": "pixel_y",
    "image_name": "image",
    "gcp_name": "name",
}
_Place = tuple[float, float, float]
_Mark = tuple[str, float, float]
CURE = "see docs/guide/georeference.md for the format"


@dataclass(frozen=True)
class ControlPoint:
    """A place with known coordinates."""

    name: str  # of the point
    position: _Place  # (east, north, height), metres, map coordinates
    # (name of a photo, x, y), pixels of the photo as stored, whose upper left corner is (0, 0)
    marks: tuple[_Mark, ...]
    is_check: bool = False  # whether it takes no part in placing a scene, and only shows its error


@dataclass(frozen=True)
class ControlPoints:
    """The ground control points of a file, in its order."""

    points: tuple[ControlPoint, ...] = ()
    crs: str = ""  # of their coordinates
    vertical: str = ""  # what their heights count from, a phrase; "" if the file does not state it
    notes: tuple[str, ...] = ()  # how heights were understood, lines for the user


def read_control_points(path: str | Path | None, crs: str | None = None, checks: Collection[str] = ()) -> ControlPoints:
    """Read ground control points; InputError if the file cannot be read, is not of this format, or
    lacks a check point.

    Parameters
    ----------
    path : of the file; None: there is none, and check points are an InputError.
    crs : as `crs.scene_crs` returns it, into which coordinates are converted. None: the
        file's, or the UTM zone if those are degrees.
    checks : names of those that are check points.
    """
    if path is None:
        if checks:
            raise InputError("--check-point: names a ground control point; give their file with --gcp")
        return ControlPoints(crs=crs or "")
    path = Path(path)
    points: dict[Any, tuple[_Place, list[_Mark]]] = {}  # by name, or place if there is none
    with reading(path, "a file of ground control points", CURE):
        text = read_regular(path).decode("utf-8-sig")
        lines = [
            (number, line)
            for number, line in enumerate(text.splitlines(), 1)
            if line.strip() and not line.lstrip().startswith("#")
        ]
        own = crs
        if lines and not _header(lines[0][1]):
            own = systems.normal_crs(lines.pop(0)[1].strip('";, \t'), str(path))
        if own is None:
            raise InputError(
                f"{path}: names no coordinate reference system; write one into the "
                "first line, such as EPSG:32632, or give --crs"
            )
        header = _header(lines[0][1]) if lines else []
        for number, line in lines[bool(header) :]:
            name, place, mark = _row(header or COLUMNS, number, line)
            known, marks = points.setdefault(name or place, (place, []))
            if known != place:
                raise InputError(f"{path}: point {name} has several coordinates; correct one, or rename it")
            marks.append(mark)
    if not points:
        raise InputError(f"{path}: has no ground control points; {CURE}")
    names = [key if isinstance(key, str) else f"point {number}" for number, key in enumerate(points, 1)]
    places, target, vertical, notes = _in_metres(path, np.array([place for place, _ in points.values()]), own, crs)
    for name, place in zip(names, places):
        if not np.isfinite(place).all():
            raise InputError(
                f"{path}: point {name.removeprefix('point ')} has no "
                f"coordinates in {target[:60]}; correct it, or the coordinate "
                "reference system in the first line"
            )
    for name in checks:
        if name not in names:
            raise InputError(
                f"--check-point {name}: {path} has no point of this name; it has {clean(', '.join(names))}"
            )
    return ControlPoints(
        tuple(
            ControlPoint(name, tuple(place), tuple(marks), name in checks)
            for name, (_, marks), place in zip(names, points.values(), places.tolist())
        ),
        target,
        vertical,
        notes,
    )


def _separator(line: str) -> str:
    return next((each for each in "\t;," if line.count(each) >= len(NUMBERS)), " ")


def _cells(line: str) -> list[str]:
    """Of a line, without quotes: names with blanks need another separator, or quotes."""
    separator = _separator(line)
    line = line.strip() if separator != " " else " ".join(line.split())
    return [cell.strip() for cell in next(csv.reader([line], delimiter=separator, skipinitialspace=True))]


def _header(line: str) -> list[str]:
    """The columns that a line names; empty: it is no header."""
    names = [OF_WEBODM.get(cell.lower(), cell.lower()) for cell in _cells(line[:LONGEST_HEADER])]
    return names if set(COLUMNS[:-1]) <= set(names) else []


def _row(header: Sequence[str], number: int, line: str) -> tuple[str, _Place, _Mark]:
    """The name of a point, its coordinates and its mark; ValueError names the fault."""
    cells = dict(zip(header, _cells(line)))
    missing = [name for name in COLUMNS[:-1] if not cells.get(name)]
    if missing:
        raise ValueError(f"line {number} lacks {', '.join(missing)}")
    comma = "." if _separator(line) == ";" else ","
    x, y, z, pixel_x, pixel_y = (
        parsed(cells[name].replace(",", comma), f"{name} of line {number}") for name in NUMBERS
    )
    return clean(cells.get("name", "")), (x, y, z), (clean(cells["image"]), pixel_x, pixel_y)


def _in_metres(
    path: Path, places: NDArray[np.float64], own: str, crs: str | None
) -> tuple[NDArray[np.float64], str, str, tuple[str, ...]]:
    """Coordinates in `crs`, or else in metres, their CRS, what heights count from, and notes.

    Heights become metres, and keep what they count from: a CRS with another vertical part is
    replaced by its horizontal one.
    """
    heights, flat = heights_of(own), horizontal(own)
    notes = []
    metres = places * (1, 1, heights.metres)
    if heights.metres != 1:
        notes.append(
            f"heights of {path} are taken as {heights.unit}, "
            f"{'of ' + heights.name if heights.name else 'the unit of its x and y'}"
        )
    if crs is not None and heights_of(crs).name not in ("", heights.name):
        notes.append(
            f"heights of {path} count from {heights.name or 'what it does not state'}, so "
            f"they are not labelled as {heights_of(crs).name}; heights are not converted"
        )
        crs = horizontal(crs)
    if crs is None and not systems.has_metres(systems.pyproj_crs(own, str(path))):
        degrees = on_ground(flat, systems.WGS84, metres)
        return *systems.map_positions(degrees[:, 1::-1], degrees[:, 2]), heights.name, (*notes,)
    # compound only if heights are in that unit
    target = crs or (own if heights.metres == 1 else flat)
    return on_ground(flat, horizontal(target), metres), target, heights.name, (*notes,)
