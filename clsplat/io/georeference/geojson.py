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


def read_polygons(path: str | Path) -> tuple[list[list[NDArray[np.float64]]], str]:
    """Read the polygons of a GeoJSON file; geometries of other kinds are left out.

    Returns
    -------
    The polygons, each a list of its outline and its holes, float64[K, 2]; and the CRS that the file
    names, "" if it names none.

    Raises
    ------
    InputError : the file is missing, is no GeoJSON, or has no polygon.
    """
    if not Path(path).exists():
        raise InputError(f"{path}: no such file; give a GeoJSON file with a polygon")
    polygons: list[list[NDArray[np.float64]]] = []
    with reading(Path(path), "GeoJSON", "export the polygons again"):
        record = object_of(read_regular(path))
        _collect(record, polygons)
    if not polygons:
        raise InputError(f"{path}: has no polygon; draw one, or give another file")
    return polygons, _crs(record)


def _collect(record: Any, polygons: list[list[NDArray[np.float64]]]) -> None:
    """Append the polygons of an object of GeoJSON; ValueError if it is none."""
    waiting = [record]
    while waiting:
        item = waiting.pop()
        if item is None:  # the geometry of a feature without a place
            continue
        match table(item, "a feature or geometry").get("type"):
            case "FeatureCollection":
                waiting += reversed(_list(item, "features"))
            case "GeometryCollection":
                waiting += reversed(_list(item, "geometries"))
            case "Feature":
                waiting.append(item.get("geometry"))
            case "Polygon":
                polygons.append(_rings(_list(item, "coordinates")))
            case "MultiPolygon":
                polygons += map(_rings, _list(item, "coordinates"))
            case "Point" | "MultiPoint" | "LineString" | "MultiLineString":
                pass
            case kind:
                raise ValueError(f"type is {str(kind)[:20]!r}")


def _list(record: dict[str, Any], key: str) -> list[Any]:
    values = record.get(key)
    if not isinstance(values, list):
        raise ValueError(f"{key} is not a list")
    return values


def _rings(rings: Any) -> list[NDArray[np.float64]]:
    if not isinstance(rings, list) or not rings:
        raise ValueError("a polygon has no outline")
    return [_ring(ring) for ring in rings]


def _ring(ring: Any) -> NDArray[np.float64]:
    if not isinstance(ring, list) or len(ring) < 3:
        raise ValueError("a polygon has fewer than three corners")
    return np.array([numbers(point[:2] if isinstance(point, list) else point, 2,
                             "a corner of a polygon") for point in ring])


def _crs(record: dict[str, Any]) -> str:
    """The CRS of the member that older files have, as pyproj accepts it."""
    crs = record.get("crs")
    properties = crs.get("properties") if isinstance(crs, dict) else None
    name = properties.get("name") if isinstance(properties, dict) else None
    return name if isinstance(name, str) and name.isprintable() and len(name) < 1000 else ""
