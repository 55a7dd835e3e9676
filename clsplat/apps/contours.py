"""Contour lines of a surface as GeoJSON (RFC 7946)."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import contourpy
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from clsplat.errors import InputError
from clsplat.io.atomic import replacing

LINES = 15  # contour lines over the usual heights, about, unless the interval is given
MOST_LINES = 1000
USUAL = (0.02, 0.98)  # quantiles of the heights
SMOOTHING = 4.0  # pixels: noise of single pixels is no contour line
SHORTEST = 48  # points of a line; shorter ones are noise
DIGITS = 9  # of heights

Heights = NDArray[np.floating]  # [H, W], nan: unknown
ContourLine = tuple[float, NDArray[np.float64]]  # its height, and (column, row) [N, 2] along it
ToPlace = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def contour_interval(heights: Heights) -> float:
    """A round number (1, 2 or 5 times a power of ten) that gives about LINES contour lines, in the
    unit of the heights; 0 for a surface without heights."""
    known = heights[~np.isnan(heights)]
    if not len(known):
        return 0.0
    low, high = np.quantile(known, USUAL)
    if not high > low:
        return 0.0
    wanted = math.log10((high - low) / LINES)
    candidates = [math.log10(factor) + math.floor(wanted) + power
                  for factor in (1, 2, 5) for power in (0, 1)]
    return float(f"{10 ** min(candidates, key=lambda each: abs(each - wanted)):.1g}")


def contour_lines(heights: Heights, interval: float) -> list[ContourLine]:
    """Contour lines of a surface.

    Parameters
    ----------
    heights : [H, W]; nan: unknown, where lines end.
    interval : between lines; heights that are multiples of it have one. 0: there are no lines.

    Returns
    -------
    All lines; the centre of the first pixel is (0.5, 0.5).

    Raises
    ------
    clsplat.ClsplatError : there would be too many lines.
    """
    known = ~np.isnan(heights)
    if interval <= 0 or not known.any() or min(heights.shape) < 2:
        return []
    smooth = np.ma.masked_array(smoothed(heights), mask=~known)
    low, high = np.quantile(heights[known], (0.001, 0.999))
    with np.errstate(over="ignore"):  # of an interval that is almost 0
        count = (high - low) / np.float64(interval)
    if count > MOST_LINES:
        raise InputError(f"--contours {interval:g}: about {count:.3g} lines; give a larger "
                         f"interval, at most {MOST_LINES:,} are drawn")
    first, last = math.ceil(low / interval), math.floor(high / interval)
    generator = contourpy.contour_generator(z=smooth)
    return [(number * interval, np.asarray(line) + 0.5) for number in range(first, last + 1)
            for line in generator.lines(number * interval) if len(line) >= SHORTEST]


def smoothed(heights: Heights) -> NDArray[np.float64]:
    """Heights [H, W] after a Gaussian filter that leaves out those that are nan."""
    known = ~np.isnan(heights)
    weight = gaussian_filter(known.astype(np.float64), SMOOTHING)
    total = gaussian_filter(np.where(known, heights, 0.0), SMOOTHING)
    result: NDArray[np.float64] = np.where(known, total / np.maximum(weight, 1e-9), np.nan)
    return result


def write_contours(path: Path, lines: list[ContourLine], to_place: ToPlace, digits: int) -> None:
    """Replace a GeoJSON file; every line is a feature with the property `elevation`.

    Parameters
    ----------
    path : the file.
    lines : of `contour_lines`.
    to_place : from (column, row) [N, 2] to the coordinates of the file [N, 2]: longitude and
        latitude of WGS 84, or the map's coordinates where the scene has no place on the earth.
    digits : of these coordinates after the point.
    """
    vertices = np.concatenate([np.empty((0, 2)), *(line for _, line in lines)])
    ends = np.cumsum([len(line) for _, line in lines])
    places = np.split(np.round(to_place(vertices), digits), ends)
    features: list[dict[str, Any]] = [
        {"type": "Feature", "properties": {"elevation": round(height, DIGITS)},
         "geometry": {"type": "LineString", "coordinates": place.tolist()}}
        for (height, _), place in zip(lines, places)]
    with replacing(path) as file:
        file.write(json.dumps({"type": "FeatureCollection", "features": features}).encode())
