"""Polygons that the user gives, in the coordinates of a model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.apps.edit import Source
from clsplat.edit.select import in_polygons
from clsplat.errors import InputError
from clsplat.georeference import Georeference
from clsplat.io.georeference.crs import conversion
from clsplat.io.georeference.geojson import DEGREES, read_polygons
from clsplat.partition.region import map_axes

GEOJSON = (".geojson", ".json")
Polygons = list[list[NDArray[np.float64]]]


def polygons_of(text: str, coordinates: str, source: Source) -> Polygons:
    """Polygons in the ground plane of a model: its original x and y where z is up.

    Parameters
    ----------
    text : the path of a GeoJSON file, or corners such as "0,0 10,0 10,10".
    coordinates : scene (original coordinates of the model), map (those of its CRS), lonlat
        (longitude and latitude), or auto: the CRS that a GeoJSON file names; otherwise lonlat for a
        GeoJSON file where the model is georeferenced, and scene for all else.
    source : the model.

    Raises
    ------
    InputError : the file or the text is no polygon, or the coordinates need a georeference.
    """
    polygons, crs = _given(text)
    known = source.georeference
    if coordinates == "scene" or coordinates == "auto" and (
            not text.lower().endswith(GEOJSON) or known is None and not crs):
        return polygons
    if known is None:
        raise InputError(f"--polygon {text[:60]}: {source.path} has no georeference, so its place "
                         "on a map is unknown; give --coordinates scene")
    if coordinates == "map" or coordinates == "auto" and crs == known.crs:
        return [[ring - known.offset[:2] for ring in rings] for rings in polygons]
    convert = conversion(crs if coordinates == "auto" and crs else DEGREES, known.crs, "--polygon")
    return [[convert(ring) - known.offset[:2] for ring in rings] for rings in polygons]


def on_ground(source: Source) -> NDArray[np.float64]:
    """[N, 2]: the gaussians of a model in the plane of `polygons_of`."""
    points = source.gaussians.positions.astype(np.float64) + source.gaussians.offset
    up = np.array([0.0, 0.0, 1.0]) if source.up is None else source.up
    return points @ map_axes(up).T


def inside(source: Source, polygons: Polygons) -> NDArray[np.bool_]:
    """bool[N]: whether the gaussians of a model stand above or below polygons."""
    return in_polygons(on_ground(source), polygons)


def box_in_scene(box: Sequence[float], coordinates: str, georeference: Georeference | None
                 ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The two corners of a box in original coordinates.

    Parameters
    ----------
    box : the lowest x, y, z, then the highest.
    coordinates : auto and scene: it is in original coordinates; map: in those of the CRS.

    Raises
    ------
    InputError : the box is empty, or the coordinates need a georeference.
    """
    low, high = np.array(box[:3], np.float64), np.array(box[3:], np.float64)
    if not (low < high).all():
        raise InputError("--box: is empty; give the lowest x, y and z, then the highest (inf and "
                         "-inf leave a side open)")
    if coordinates in ("auto", "scene"):
        return low, high
    if coordinates == "lonlat":
        raise InputError("--box: cannot be in degrees; use --polygon, or --coordinates map")
    if georeference is None:
        raise InputError("--box: the model has no georeference, so its place on a map is unknown; "
                         "give --coordinates scene")
    return low - georeference.offset, high - georeference.offset


def _given(text: str) -> tuple[Polygons, str]:
    if text.lower().endswith(GEOJSON):
        return read_polygons(Path(text))
    try:
        corners = np.array([[float(value) for value in corner.split(",")]
                            for corner in text.split()])
    except ValueError:
        corners = np.empty(0)
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3 or not np.isfinite(
            corners).all():
        raise InputError(f"--polygon {text[:60]}: expects at least three corners such as "
                         "\"0,0 10,0 10,10\", or a GeoJSON file")
    return [[corners]], ""
