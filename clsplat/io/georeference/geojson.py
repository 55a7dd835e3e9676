"""Lines and polygons of a GeoJSON file (RFC 7946), in the coordinates of a map."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError, clean, reason
from clsplat.io.georeference.crs import WGS84, normal_crs, on_ground
from clsplat.io.records import object_of
from clsplat.io.regular import read_regular

KINDS = {"LineString": "line", "MultiLineString": "line", "Polygon": "polygon", "MultiPolygon": "polygon"}
LEAST_VERTICES = {"line": 2, "polygon": 4}  # the last of a ring is the first
NAMES = "name", "Name", "id", "label"  # properties, of which the first that is there names it
LONGEST_NAME = 60  # characters
Line = NDArray[np.float64]  # [N, 2], map coordinates


@dataclass(frozen=True, eq=False)
class Feature:
    """A line or a polygon.

    Attributes
    ----------
    name : its property, or "feature 3".
    kind : "line" or "polygon".
    parts : of a line its parts; of a polygon the rings of each of its parts, the outer one first.
    """

    name: str
    kind: str
    parts: tuple[tuple[Line, ...], ...]

    @property
    def lines(self) -> list[Line]:
        """All lines, or all rings."""
        return [line for part in self.parts for line in part]

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """(left, bottom, right, top)."""
        places = np.concatenate(self.lines)
        (left, bottom), (right, top) = places.min(axis=0), places.max(axis=0)
        return float(left), float(bottom), float(right), float(top)


def read_features(path: Path, crs: str | None) -> list[Feature]:
    """Read the lines and polygons of a file.

    Parameters
    ----------
    path : GeoJSON. Its coordinates are longitude and latitude as in RFC 7946, in the CRS that a
        member `crs` names as in the standard of 2008, or, if they cannot be degrees, in `crs`.
    crs : of the map; None: its coordinates are local, and so are those of the file.
    """
    try:
        table = object_of(read_regular(path))
        found = [_feature(item, number) for number, item in enumerate(_items(table), 1)]
        source = _source(table, found, crs, path)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; give a GeoJSON file of lines and polygons") from None
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path}: not GeoJSON of lines and polygons ({reason(error)}); export it anew from a GIS program"
        ) from None
    if source == crs or source is None:
        return found
    assert crs is not None  # else there is no source
    return [
        Feature(
            each.name,
            each.kind,
            tuple(tuple(_converted(line, source, crs, f"{path}: {each.name}") for line in part) for part in each.parts),
        )
        for each in found
    ]


def _items(table: dict[str, Any]) -> list[Any]:
    """The features of a file; a lone feature or geometry is one, too."""
    kind = table.get("type")
    items = (
        table.get("features")
        if kind == "FeatureCollection"
        else [table]
        if kind == "Feature"
        else [{"geometry": table}]
    )
    if not isinstance(items, list) or not items:
        raise ValueError("it has no features")
    return items


def _feature(item: Any, number: int) -> Feature:
    """A feature; ValueError unless it is a line or a polygon."""
    item = item if isinstance(item, dict) else {}
    properties, shape = item.get("properties") or {}, item.get("geometry") or {}
    name = (
        next((str(properties[key]) for key in NAMES if properties.get(key) not in (None, "")), f"feature {number}")
        if isinstance(properties, dict)
        else f"feature {number}"
    )
    name = clean(name)[:LONGEST_NAME]
    word = shape.get("type") if isinstance(shape, dict) else None
    if not isinstance(word, str) or word not in KINDS:
        raise ValueError(f"{name} is {clean(str(word or 'without a geometry'))[:40]}")
    kind, given = KINDS[word], shape.get("coordinates")
    nested: Any = given if word.startswith("Multi") else [given]
    try:
        parts = tuple(tuple(_line(ring, kind) for ring in (part if kind == "polygon" else [part])) for part in nested)
        if not parts or not all(parts):
            raise ValueError
    except (TypeError, ValueError, IndexError):
        raise ValueError(f"{name} has coordinates of no {kind}") from None
    return Feature(name, kind, parts)


def _line(coordinates: Any, kind: str) -> Line:
    """A line or ring; ValueError if it is none."""
    if not all(type(value) in (int, float) for place in coordinates for value in place[:2]):
        raise ValueError
    line: Line = np.array([place[:2] for place in coordinates], np.float64)
    if line.ndim != 2 or line.shape[1] != 2 or len(line) < LEAST_VERTICES[kind]:
        raise ValueError
    if kind == "polygon" and (line[0] != line[-1]).any():
        raise ValueError
    return line


def _source(table: dict[str, Any], found: list[Feature], crs: str | None, path: Path) -> str | None:
    """The CRS of a file's coordinates; None: the local ones of the map."""
    named = table.get("crs")
    if named is not None:
        try:
            text = str(named["properties"]["name"])
        except (KeyError, TypeError):
            raise ValueError("its crs has no name") from None
        if crs is None:
            raise InputError(
                f"{path}: names the system {clean(text)[:40]}, but the map has no "
                "georeference; write the coordinates of the map, without a crs"
            )
        return normal_crs(text, f"{path}: crs")
    if crs is None:
        return None
    places = np.abs(np.concatenate([line for each in found for line in each.lines]))
    return WGS84 if (places <= (180, 90)).all() else crs


def _converted(line: Line, source: str, crs: str, name: str) -> Line:
    """A line in the CRS of the map."""
    places: Line = on_ground(source, crs, np.pad(line, ((0, 0), (0, 1))))[:, :2]
    if not np.isfinite(places).all():
        raise InputError(f"{name}: has no place on the map; check which system its coordinates are in")
    return places
