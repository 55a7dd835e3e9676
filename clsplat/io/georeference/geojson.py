"""Polygons from GeoJSON files (RFC 7946, and older files that name their CRS)."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.io.fields import numbers, reading, table
from clsplat.io.records import object_of
from clsplat.io.regular import read_regular

DEGREES = "OGC:CRS84"  # longitude and latitude, which RFC 7946 prescribes
MEMBERS = {"FeatureCollection": "features", "GeometryCollection": "geometries"}
OTHERS = ("Point", "MultiPoint", "LineString", "MultiLineString")
Polygon = list[NDArray[np.float64]]  # the outline and the holes, [K, 2]


def read_polygons(path: str | Path) -> tuple[list[Polygon], str]:
    """Read the polygons of a GeoJSON file, and the CRS that it names, "" if it names none;
    geometries of other kinds are left out."""
    with reading(path, "GeoJSON", "export the polygons again"):
        record = object_of(read_regular(path))
        polygons = list(_polygons(record))
    if not polygons:
        raise InputError(f"{path}: has no polygon; draw one, or give another file")
    try:
        crs = str(record["crs"]["properties"]["name"])  # of older files, as pyproj accepts it
    except (KeyError, TypeError, IndexError):
        crs = ""
    return polygons, crs


def _polygons(item: Any) -> Iterator[Polygon]:
    """The polygons of a geometry, a feature or a collection."""
    kind = table(item, "a feature or geometry").get("type")
    if kind in MEMBERS:
        for member in _list(item.get(MEMBERS[kind])):
            yield from _polygons(member)
    elif kind == "Feature":
        if item.get("geometry") is not None:  # it may have no place
            yield from _polygons(item["geometry"])
    elif kind == "Polygon":
        yield _rings(item.get("coordinates"))
    elif kind == "MultiPolygon":
        yield from map(_rings, _list(item.get("coordinates")))
    elif kind not in OTHERS:
        raise ValueError(f"type is {str(kind)[:20]!r}")


def _rings(rings: Any) -> Polygon:
    return [np.array([numbers(_list(corner, 2)[:2], 2, "a corner of a polygon")
                      for corner in _list(ring, 3)]) for ring in _list(rings, 1)]


def _list(values: Any, least: int = 0) -> list[Any]:
    if not isinstance(values, list) or len(values) < least:
        raise ValueError("a list is missing, or too short for a polygon")
    return values
