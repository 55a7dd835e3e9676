"""Polygons from GeoJSON files (RFC 7946, and older files that name their CRS)."""

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


def read_polygons(path: str | Path) -> tuple[list[list[NDArray[np.float64]]], str]:
    """Read the polygons of a GeoJSON file; geometries of other kinds are left out.

    Returns
    -------
    The polygons, each a list of its outline and its holes, float64[K, 2]; and the CRS that the file
    names, "" if it names none.
    """
    if not Path(path).exists():
        raise InputError(f"{path}: no such file; give a GeoJSON file with a polygon")
    polygons: list[list[NDArray[np.float64]]] = []
    with reading(Path(path), "GeoJSON", "export the polygons again"):
        record = object_of(read_regular(path))
        waiting: list[Any] = [record]
        while waiting:
            item = waiting.pop()
            if item is None:  # the geometry of a feature without a place
                continue
            kind = table(item, "a feature or geometry").get("type")
            if kind in MEMBERS:
                waiting += reversed(_list(item.get(MEMBERS[kind])))
            elif kind == "Feature":
                waiting.append(item.get("geometry"))
            elif kind in ("Polygon", "MultiPolygon"):
                found = _list(item.get("coordinates"))
                polygons += [_rings(each) for each in ([found] if kind == "Polygon" else found)]
            elif kind not in OTHERS:
                raise ValueError(f"type is {str(kind)[:20]!r}")
    if not polygons:
        raise InputError(f"{path}: has no polygon; draw one, or give another file")
    return polygons, _crs(record)


def _list(values: Any, least: int = 0) -> list[Any]:
    if not isinstance(values, list) or len(values) < least:
        raise ValueError("a list is missing, or too short for a polygon")
    return values


def _rings(rings: Any) -> list[NDArray[np.float64]]:
    return [np.array([numbers(point[:2] if isinstance(point, list) else point, 2,
                              "a corner of a polygon") for point in _list(ring, 3)])
            for ring in _list(rings, 1)]


def _crs(record: dict[str, Any]) -> str:
    """The CRS of the member that older files have, as pyproj accepts it."""
    crs = record.get("crs")
    properties = crs.get("properties") if isinstance(crs, dict) else None
    name = properties.get("name") if isinstance(properties, dict) else None
    return name if isinstance(name, str) and name.isprintable() and len(name) < 1000 else ""
