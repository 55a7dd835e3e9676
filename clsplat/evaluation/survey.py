"""What a surveyor asks of a scene: how much the photos cover, how finely, and how well it fits."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.georeference import AxisError, Georeference, Residual, axis_errors
from clsplat.io.georeference.crs import heights_of
from clsplat.io.photos.metadata import read_metadata
from clsplat.io.records import object_of
from clsplat.io.regular import read_regular
from clsplat.io.scenes.sources import photo_folder
from clsplat.partition.region import map_axes
from clsplat.scene import Scene
from clsplat.sfm.photos import RECORD

CELLS = 72  # of the longer side of the map of overlap
EXTENT = (0.01, 0.99)  # quantiles of the points that the map of overlap contains
CLOSED = 3  # cells: holes between points up to about twice as wide are covered ground
MOST_POINTS = 20_000  # of the sparse model, which the maps and the sizes need
MOST_MEASURED = 300  # photos whose ground sampling distance is measured
UNKNOWN_HEIGHTS = "unknown: the vertical system of the scene"
ABOVE = 0.8  # quantile of the heights of points above which the cameras of a flight are


@dataclass(frozen=True, eq=False)
class Overlap:
    """How many photos look at the places of a map, whatever stands in between.

    Attributes
    ----------
    counts : int[R, C], from south to north and from west to east; -1 where there are no points.
    bounds : (west, east, south, north), map coordinates without the offset of a georeference.
    covered : the area at which at least two photos look, square units of the map.
    mean : the mean number of photos that look at a place of the map.
    thin : the share of the map at which fewer than three photos look.
    """

    counts: NDArray[np.intp]
    bounds: tuple[float, float, float, float]
    covered: float
    mean: float
    thin: float


@dataclass(frozen=True, eq=False)
class Survey:
    """A scene as a survey.

    Attributes
    ----------
    names : of the photos.
    cameras : float64[N, 2], their places on the map; without the offset of a georeference.
    ground : float64[M, 2], a part of the points on the map.
    record : sfm.json, {} if the scene was not made by `clsplat sfm`.
    georeference : of the scene; None: its units are unknown.
    overlap : None if the photos were not taken from above.
    pixel : map units on the ground, the size of a pixel of the photos, median; None: unknown.
    height : map units, the median distance of the points from the photos that show them.
    """

    names: tuple[str, ...]
    cameras: NDArray[np.float64]
    ground: NDArray[np.float64]
    record: dict[str, Any]
    georeference: Georeference | None
    overlap: Overlap | None
    pixel: float | None
    height: float | None

    @property
    def residuals(self) -> tuple[Residual, ...]:
        """The residual of each measured place, if they are recorded."""
        return self.georeference.residuals if self.georeference else ()

    @property
    def camera_residuals(self) -> NDArray[np.float64]:
        """float64[N], metres, how far the place of each photo is from its GPS; nan: unknown."""
        lengths = {
            each.name: float(np.linalg.norm([each.east, each.north, each.up or 0.0]))
            for each in self.residuals
            if each.pixels is None
        }
        return np.array([lengths.get(name, np.nan) for name in self.names])


@dataclass(frozen=True)
class Photographs:
    """How the photos of a scene were taken, by their files.

    Attributes
    ----------
    cameras : of each camera, with the size of its photos, how many there are.
    period : when the first and the last one were taken; with a time zone in UTC, else by the clock
        of the camera, whose zone is unknown; None: no file tells it.
    """

    cameras: dict[str, int]
    period: tuple[datetime, datetime] | None


def photographs_of(scene: Scene) -> Photographs:
    """What the files of a scene's photos record."""
    folder, cameras, times = photo_folder(scene.path), Counter[str](), list[datetime]()
    # undistorted photos have lost their EXIF, and a wide lens has several views of one photo
    for path in dict.fromkeys(
        view.source if not (folder / view.name).is_file() else folder / view.name
        for view in scene.views
        if isinstance(view.source, Path)
    ):
        known = read_metadata(path)
        name = " ".join(dict.fromkeys(known.camera.split()))  # a model may begin with its maker
        cameras[f"{name or 'unknown camera'}, {known.width} x {known.height} pixels"] += 1
        times += [known.taken] if known.taken else []
    used = [each.astimezone(timezone.utc) for each in times if each.tzinfo] or times
    return Photographs(dict(cameras), (min(used), max(used)) if used else None)


def vertical_reference(place: Georeference | None) -> str:
    """What heights count from, as far as it is known."""
    known = place and (place.vertical or heights_of(place.crs).name)
    return known or UNKNOWN_HEIGHTS


def record_of(scene: Scene) -> dict[str, Any]:
    """The sfm.json of a scene; {} where there is none, or none that can be read."""
    try:
        return object_of(read_regular(scene.path / RECORD))
    except (OSError, ValueError):
        return {}


def survey_of(scene: Scene) -> Survey:
    """A scene, with one or more cameras of the size of its photos, as a survey."""
    axes = np.vstack([map_axes(scene.up), scene.up])

    points = scene.points[:: max(1, len(scene.points) // MOST_POINTS)]
    points = points[np.isfinite(points).all(axis=1)]
    positions = np.array([view.camera.position for view in scene.views])
    cameras, ground = ((scene.offset + scene.unit * places) @ axes.T for places in (positions, points))
    distances, pixels = ground_samples(scene, points)
    above = len(points) and np.median(cameras[:, 2]) > np.quantile(ground[:, 2], ABOVE)
    return Survey(
        tuple(view.name for view in scene.views),
        cameras[:, :2],
        ground[:, :2],
        record_of(scene),
        scene.georeference,
        _overlap(scene, ground, axes) if above else None,
        scene.unit * float(np.median(pixels)) if pixels else None,
        scene.unit * float(np.median(distances)) if distances else None,
    )


def ground_samples(scene: Scene, points: NDArray[np.float64]) -> tuple[list[float], list[float]]:
    """The median depth of points float64[N, 3] in each of some photos that show any, and the size
    of a pixel there, local units."""
    depths, pixels = [], []
    for view in scene.views[:: max(1, len(scene.views) // MOST_MEASURED)]:
        seen = points[view.sees(points)]
        if len(seen):
            depths.append(float(np.median(view.camera.project(seen)[1])))
            pixels.append(depths[-1] / view.camera.focal[0])
    return depths, pixels


def _overlap(scene: Scene, ground: NDArray[np.float64], axes: NDArray[np.float64]) -> Overlap | None:
    """The map of overlap, on the heights of the points nearby: points [M, 3] in the axes of the
    map, which are the rows of `axes` [3, 3] in original coordinates."""
    low, high = np.quantile(ground[:, :2], EXTENT, axis=0)
    size = float((high - low).max()) / CELLS
    if not size > 0:
        return None
    columns, rows = (np.ceil((high - low) / size).astype(int) + 1).tolist()
    cells = np.floor((ground[:, :2] - low) / size).astype(int)
    inside = ((cells >= 0) & (cells < (columns, rows))).all(axis=1)
    flat = cells[inside, 1] * columns + cells[inside, 0]
    found = np.bincount(flat, minlength=rows * columns).reshape(rows, columns)
    sums = np.bincount(flat, ground[inside, 2], rows * columns).reshape(rows, columns)
    nearest = scipy.ndimage.distance_transform_edt(found == 0, return_distances=False, return_indices=True)
    heights = (sums / np.maximum(found, 1))[tuple(nearest)]
    # the border of the closing is empty: pad, so that ground at the edge stays covered
    closed = scipy.ndimage.binary_closing(np.pad(found > 0, CLOSED), iterations=CLOSED)
    row, column = np.nonzero(closed[CLOSED:-CLOSED, CLOSED:-CLOSED])
    middles = np.column_stack([low[0] + size * (column + 0.5), low[1] + size * (row + 0.5), heights[row, column]])
    local = (middles @ axes - scene.offset) / scene.unit
    seen = sum((view.sees(local).astype(int) for view in scene.views), np.zeros(len(local), int))
    counts = np.full((rows, columns), -1)
    counts[row, column] = seen
    west, south = low.tolist()
    return Overlap(
        counts,
        (west, west + size * columns, south, south + size * rows),
        size**2 * int((seen >= 2).sum()),
        float(seen.mean()),
        float((seen < 3).mean()),
    )


def spreads(residuals: Sequence[Residual]) -> dict[str, AxisError]:
    """As `axis_errors`, and "along the ground"."""
    result = axis_errors(residuals)
    if result:
        along = np.array([np.hypot(each.east, each.north) for each in residuals])
        result["along the ground"] = AxisError(
            None, None, float(np.sqrt(np.mean(along**2))), float(np.quantile(along, 0.9))
        )
    return result
