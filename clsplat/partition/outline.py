"""The outlines of blocks on a map, as polygons and as GeoJSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.partition.input import CONTENT_QUANTILES, world_of

if TYPE_CHECKING:
    from clsplat.partition.partition import Partition
    from clsplat.partition.region import Region
    from clsplat.scene import Scene

SIDE_POINTS = 48  # on each side of a cell in contracted space, where straight sides are curves
END_DISTANCE = 1e-3  # from the ends of contracted space, where unbounded cells end before clipping
MARGIN = 0.05  # share of the extent around everything, to which unbounded cells are drawn


def extent(partition: Partition, scene: Scene) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The low [2] and high [2] end of the map along u and v, world units from the space's origin.

    The map contains all cameras, and the sparse points without outliers.
    """
    axes, origin = partition.space.rotation[:2], partition.space.origin
    points = (world_of(scene, scene.points) - origin) @ axes.T
    cameras = (world_of(scene, [v.camera.position for v in scene.views]) - origin) @ axes.T
    ends = np.concatenate([np.quantile(points, CONTENT_QUANTILES, axis=0), cameras])
    low, high = ends.min(axis=0), ends.max(axis=0)
    margin = MARGIN * max((high - low).max(), np.finfo(float).tiny)
    return low - margin, high + margin


def outline(region: Region, low: NDArray[np.float64], high: NDArray[np.float64]
            ) -> NDArray[np.float64]:
    """The corners [K, 2] on the map of a Region's outline at the height of its space's origin.

    It is clipped to `low` [2] and `high` [2] along u and v; K is 0 where nothing is left.
    """
    space = region.space
    if space.contracted:
        first, last = (np.maximum(region.low, END_DISTANCE)[:2],
                       np.minimum(region.high, 1 - END_DISTANCE)[:2])
        middle = 0.5
    else:
        first = np.maximum(region.low[:2], low / space.half[:2])
        last = np.minimum(region.high[:2], high / space.half[:2])
        middle = 0.0
    if not (first < last).all():
        return np.zeros((0, 2))
    step = np.linspace(0, 1, SIDE_POINTS + 1 if space.contracted else 2)[:-1, None]
    corners = np.array([first, (last[0], first[1]), last, (first[0], last[1])])
    ring = np.concatenate([a + step * (b - a) for a, b in zip(corners, np.roll(corners, -1, 0))])
    world = space.world(np.column_stack([ring, np.full(len(ring), middle)]))
    along = _clipped((world - space.origin) @ space.rotation[:2].T, low, high)
    return space.map(space.origin + along @ space.rotation[:2])


def centroid(ring: NDArray[np.float64]) -> NDArray[np.float64]:
    """The centroid [2] of a polygon [K, 2]."""
    a = ring - ring[0]  # far from the origin, products of coordinates would lose digits
    b = np.roll(a, -1, 0)
    cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    centre: NDArray[np.float64] = ring[0] + cross @ (a + b) / (3 * cross.sum())
    return centre


def _clipped(polygon: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64]
             ) -> NDArray[np.float64]:
    """The part of a polygon [K, 2] inside a rectangle (Sutherland and Hodgman 1974)."""
    for axis in (0, 1):
        for sign, end in ((1, low[axis]), (-1, high[axis])):
            beyond = sign * (polygon[:, axis] - end)  # negative: outside
            kept = []
            for a, b, at, bt in zip(polygon, np.roll(polygon, -1, 0), beyond, np.roll(beyond, -1)):
                if at >= 0:
                    kept.append(a)
                if (at >= 0) != (bt >= 0):
                    kept.append(a + at / (at - bt) * (b - a))
            polygon = np.array(kept).reshape(-1, 2)
    return polygon


def geojson(partition: Partition, scene: Scene, facts: Sequence[dict[str, Any]] = ()
            ) -> dict[str, Any]:
    """A GeoJSON FeatureCollection with a polygon for each block and a point for each camera.

    Coordinates are those of `Space.map`, in world units, not geographic ones. Unbounded cells end
    a little beyond everything else. `facts` : for each block more properties of its polygon.
    """
    low, high = extent(partition, scene)
    features: list[dict[str, Any]] = []

    def add(kind: str, coordinates: list[Any], properties: dict[str, Any]) -> None:
        features.append({"type": "Feature", "properties": properties,
                         "geometry": {"type": kind, "coordinates": coordinates}})

    for block, (region, views) in enumerate(zip(partition.regions, partition.views)):
        ring = outline(region, low, high)
        rings = [[*ring.tolist(), ring[0].tolist()]] if len(ring) else []
        add("Polygon", rings, {"block": block, "views": len(views),
                               **(facts[block] if facts else {})})
    blocks = np.zeros(len(scene.views), int)
    for views in partition.views:
        blocks[views] += 1
    for index, view in enumerate(scene.views):
        place = partition.space.map(world_of(scene, view.camera.position))[0]
        dropped = partition.dropped.get(index)
        add("Point", place.tolist(), {"view": view.name, "blocks": int(blocks[index]),
                                      **({"dropped": dropped} if dropped else {})})
    return {"type": "FeatureCollection", "features": features}


