"""Polygons from GeoJSON files (RFC 7946, and older files that name their CRS)."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.io.reason import reason
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
    try:
        record = object_of(read_regular(path))
        polygons: list[list[NDArray[np.float64]]] = []
        _collect(record, polygons)
        crs = _crs(record)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; give a GeoJSON file with a polygon") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not GeoJSON, or damaged ({reason(error)}); export the polygons "
                         "again") from None
    if not polygons:
        raise InputError(f"{path}: has no polygon; draw one, or give another file")
    return polygons, crs


def _collect(record: Any, polygons: list[list[NDArray[np.float64]]]) -> None:
    """Append the polygons of an object of GeoJSON; ValueError if it is none."""
    waiting = [record]
    while waiting:
        item = waiting.pop()
        if item is None:  # the geometry of a feature without a place
            continue
        if not isinstance(item, dict):
            raise ValueError("a feature or geometry is not an object")
        match item.get("type"):
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
    points = []
    for point in ring if isinstance(ring, list) else ():
        if not (isinstance(point, list) and len(point) >= 2
                and all(type(value) in (int, float) and abs(value) < 1e15 for value in point[:2])):
            raise ValueError("a corner of a polygon is not a pair of numbers")
        points.append([float(value) for value in point[:2]])
    if len(points) < 3:
        raise ValueError("a polygon has fewer than three corners")
    return np.array(points)


def _crs(record: dict[str, Any]) -> str:
    """The CRS of the member that older files have, as pyproj knows it."""
    crs = record.get("crs")
    properties = crs.get("properties") if isinstance(crs, dict) else None
    name = properties.get("name") if isinstance(properties, dict) else None
    return name if isinstance(name, str) and name.isprintable() and len(name) < 1000 else ""
