"""Lengths, areas and volumes on the surface of a map, of the lines and polygons of a file."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.apps.differences import DETECTION, difference_of, heights_at, middles, nmad, noise_of
from clsplat.apps.geotiff import Surface, coverage, read_surface
from clsplat.errors import InputError
from clsplat.io.atomic import replacing
from clsplat.io.folders import make_folder
from clsplat.io.georeference.geojson import Feature, Line
from clsplat.io.records import plain, write_object

RECORD, TABLE, PROFILES = "measurements.json", "measurements.csv", "profiles.csv"
FILES = RECORD, TABLE, PROFILES
BASES = "fit", "lowest", "mean"  # of a plane through the border of a polygon
SMOOTHING = 4.0  # pixels along a profile: noise of single pixels makes no way longer
MOST_SIDE = 2048  # pixels of a feature
MOST_STEPS = 1_000_000  # pixels along a line or a border
CROSSING = 0.02  # of the area: by how much it may differ from that of the pixels within

Profile = NDArray[np.float64]  # [N, 4]: distance from the beginning, x, y, height


class Measurements(NamedTuple):
    """What was measured.

    Attributes
    ----------
    record : what RECORD holds.
    profiles : of the lines, by the number of the feature.
    """

    record: dict[str, Any]
    profiles: dict[int, Profile]


def measure(
    path: Path, features: list[Feature], base: str | float = BASES[0], before: Path | None = None
) -> Measurements:
    """Measure features on a surface.

    Parameters
    ----------
    path : of the surface, GeoTIFF.
    features : in its coordinates.
    base : of volumes: one of BASES, or a height.
    before : an earlier surface of the same place, which volumes between the two are measured from.
    """
    profiles, rows = {}, []
    whole = read_surface(path)
    change = None if before is None else difference_of(whole, read_surface(before))
    stable = None if change is None else _outside(change, features)
    for number, feature in enumerate(features, 1):
        surface = _around(path, feature)
        if feature.kind == "line":
            found, profiles[number] = _line(surface, feature)
        else:
            found = _polygon(surface, feature, base)
            if change is not None and stable is not None:
                found |= _change(change.within(feature.bounds), feature, stable)
        rows.append({"name": feature.name, "kind": feature.kind, **found})
    record = {"surface": str(path), "crs": whole.crs, "unit": whole.unit, "base": base, "features": rows}
    if stable is not None:
        record |= {
            "before": str(before),
            "noise": nmad(stable),
            "level_of_detection": DETECTION * nmad(stable),
            "offset": float(np.nanmedian(stable)),
        }
    return Measurements(plain(record), profiles)


def _around(path: Path, feature: Feature) -> Surface:
    """The part of a surface with a feature."""
    try:
        surface = read_surface(path, feature.bounds, MOST_SIDE)
    except InputError as error:
        raise InputError(f"{feature.name}: {error}") from None
    way = sum(float(along(line, np.inf)[-1, 0]) for line in feature.lines)
    if way > MOST_STEPS * surface.grid.resolution:
        raise InputError(
            f"{feature.name}: is {way:.3g} {surface.unit} long, far more than {path}; "
            "draw it within what the map covers"
        )
    if not np.isfinite(surface.heights).any():
        raise InputError(f"{feature.name}: {path} has no heights there; draw it within what the map covers")
    return surface


def along(line: Line, step: float) -> Profile:
    """Places along a line at about this step, with nan for heights."""
    distance = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    steps = np.linspace(0, distance[-1], max(1, math.ceil(distance[-1] / step)) + 1)
    return np.column_stack(
        [steps, *(np.interp(steps, distance, values) for values in line.T), np.full(len(steps), np.nan)]
    )


def _line(surface: Surface, feature: Feature) -> tuple[dict[str, Any], Profile]:
    """The lengths of a line, and its profile."""
    parts, length, way = [], 0.0, 0.0
    for line in feature.lines:
        part = along(line, surface.grid.resolution)
        part[:, 3] = heights_at(surface, part[:, 1], part[:, 2])
        known = np.isfinite(part[:, 3])
        level = np.interp(part[:, 0], *part[known][:, ::3].T) if known.any() else 0 * part[:, 0]
        smooth = scipy.ndimage.gaussian_filter1d(level, SMOOTHING, mode="nearest")
        way += float(np.hypot(np.diff(part[:, 0]), np.diff(smooth)).sum())
        parts.append(part + (length, 0, 0, 0))
        length += float(part[-1, 0])
    profile = np.concatenate(parts)
    heights = profile[np.isfinite(profile[:, 3]), 3]
    if not len(heights):
        raise InputError(f"{feature.name}: {surface.path} has no heights along it; draw it within what the map covers")
    return {
        "length": length,
        "surface_length": way,
        "lowest": heights.min(),
        "highest": heights.max(),
        "known": len(heights) / len(profile),
    }, profile


def _polygon(surface: Surface, feature: Feature, base: str | float) -> dict[str, Any]:
    """The area and the heights of a polygon, and its volume above and below a base."""
    weights = _weights(surface, feature)
    x, y = middles(surface.grid)
    known = (weights > 0) & np.isfinite(surface.heights)
    if not known.any():
        raise InputError(f"{feature.name}: {surface.path} has no heights in it; draw it within what the map covers")
    shares, heights = weights[known], surface.heights[known]
    middle = np.array([x[known].mean(), y[known].mean()])
    plane = _base(surface, feature, base, middle)
    away = np.column_stack([x[known] - middle[0], y[known] - middle[1], np.ones(len(heights))])
    rise = (heights - away @ plane) * shares * surface.grid.resolution**2
    return {
        "area": area_of(feature),
        "lowest": heights.min(),
        "mean": np.average(heights, weights=shares),
        "highest": heights.max(),
        "known": _share(shares, surface, feature),
        "base_height": plane[2],
        "base_slope": np.hypot(*plane[:2]),
        "above": rise[rise > 0].sum(),
        "below": -rise[rise < 0].sum(),
        "volume": rise.sum(),
    }


def _share(weights: NDArray[np.float64], surface: Surface, feature: Feature) -> float:
    """The share of a polygon that pixels with weights are."""
    return min(1.0, float(weights.sum()) * surface.grid.resolution**2 / area_of(feature))


def _base(surface: Surface, feature: Feature, base: str | float, middle: NDArray[np.float64]) -> NDArray[np.float64]:
    """The slopes along x and y of a base, and its height in the middle, [3]."""
    if not isinstance(base, str):
        return np.array([0, 0, base])
    x, y = np.concatenate([along(ring, surface.grid.resolution) for ring in feature.lines])[:, 1:3].T
    heights = heights_at(surface, x, y)
    shown = np.isfinite(heights)
    if shown.sum() < 3:
        raise InputError(f"{feature.name}: no height of its border is known; give --base as a number")
    if base != "fit":
        level = np.min(heights[shown]) if base == "lowest" else np.mean(heights[shown])
        return np.array([0, 0, level])
    matrix = np.column_stack([x - middle[0], y - middle[1], np.ones(len(x))])
    plane: NDArray[np.float64] = np.linalg.lstsq(matrix[shown], heights[shown])[0]
    return plane


def _weights(surface: Surface, feature: Feature) -> NDArray[np.float64]:
    """[rows, columns]: the share of each pixel within a polygon; InputError if it crosses itself."""
    weights, grid = coverage(surface.grid, feature.parts), surface.grid
    left, bottom, right, top = feature.bounds
    area = area_of(feature)
    edge = grid.resolution * sum(along(ring, np.inf)[-1, 0] for ring in feature.lines)
    within = grid.bounds[0] <= left and grid.bounds[1] <= bottom and right <= grid.bounds[2] and top <= grid.bounds[3]
    if area <= 0 or within and abs(weights.sum() * grid.resolution**2 - area) > (CROSSING * area + edge / 4):
        raise InputError(f"{feature.name}: its border crosses itself, or it has no area; draw it anew")
    return weights


def area_of(feature: Feature) -> float:
    """The area of a polygon, by its vertices; holes are not counted."""
    total = 0.0
    for outer, *holes in feature.parts:
        total += _area(outer) - sum(map(_area, holes))
    return total


def _area(ring: Line) -> float:
    x, y = (ring - ring[0]).T
    return abs(float(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]))) / 2


def _outside(change: Surface, features: list[Feature]) -> NDArray[np.float64]:
    """Differences of two surfaces, nan within polygons."""
    stable = change.heights.copy()
    for feature in features:
        if feature.kind == "polygon":
            rows, columns = change.slices(feature.bounds)
            inside = coverage(change.within(feature.bounds).grid, feature.parts) > 0
            stable[rows, columns][inside] = np.nan
    if not np.isfinite(stable).any():
        raise InputError(
            f"{change.path}: shares no known place outside of the polygons with the "
            "surface before it, so that their noise is unknown; draw smaller "
            "polygons, or give maps of one place"
        )
    return stable


def _change(change: Surface, feature: Feature, stable: NDArray[np.float64]) -> dict[str, Any]:
    """The volumes between two surfaces in a polygon: of their difference there, and where nothing
    changed."""
    weights, pixel = coverage(change.grid, feature.parts), change.grid.resolution
    known = (weights > 0) & np.isfinite(change.heights)
    volume = (change.heights * weights)[known] * pixel**2
    sure = np.abs(change.heights[known]) > DETECTION * nmad(stable)
    return {
        "fill": volume[sure & (volume > 0)].sum(),
        "cut": -volume[sure & (volume < 0)].sum(),
        "net": volume.sum(),
        "net_noise": noise_of(stable, pixel, area_of(feature)),
        "compared": _share(weights[known], change, feature),
    }


def write_measurements(measured: Measurements, folder: Path) -> None:
    """Write FILES into a folder, which is created; PROFILES only if there are lines."""
    make_folder(folder)
    rows = measured.record["features"]
    keys = list(dict.fromkeys(key for row in rows for key in row))
    _write_csv(folder / TABLE, keys, ([row.get(key, "") for key in keys] for row in rows))
    (folder / PROFILES).unlink(missing_ok=True)
    if measured.profiles:
        _write_csv(
            folder / PROFILES,
            ["feature", "name", "distance", "x", "y", "height"],
            (
                [
                    number,
                    rows[number - 1]["name"],
                    *("" if np.isnan(value) else round(value, 4) for value in place.tolist()),
                ]
                for number, profile in measured.profiles.items()
                for place in profile
            ),
        )
    write_object(folder / RECORD, measured.record, indent=2)


def _write_csv(path: Path, head: list[str], rows: Any) -> None:
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow(head)
    writer.writerows(rows)
    with replacing(path) as file:
        file.write(text.getvalue().encode())
