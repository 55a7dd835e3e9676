"""The outlines of blocks on a map, as polygons and as GeoJSON."""

import numpy as np

from clsplat.partition.site import world_of

STEPS = 48  # along each side of a cell: contracted space bends them
FAR = 1e-3  # how near to the end of contracted space an endless cell is drawn, before it is clipped
ROOM = 0.05  # of the extent, around everything, to which endless cells are drawn
BULK = (0.01, 0.99)  # quantiles of the sparse points that are on the map


def extent(partition, scene):
    """(low float64[2], high float64[2]) along u and v in world units, from the space's origin: what
    holds the cameras and the sparse points but for outliers."""
    axes, origin = partition.space.rotation[:2], partition.space.origin
    points = (world_of(scene, scene.points) - origin) @ axes.T
    cameras = (world_of(scene, [v.camera.position for v in scene.views]) - origin) @ axes.T
    ends = np.concatenate([np.quantile(points, BULK, axis=0), cameras])
    low, high = ends.min(axis=0), ends.max(axis=0)
    room = ROOM * max((high - low).max(), np.finfo(float).tiny)
    return low - room, high + room


def outline(region, low, high):
    """float64[K, 2]: the corners on the map of a Region's outline at the height of its space's
    origin, clipped to low and high along u and v; K is 0 where nothing is left."""
    space = region.space
    if space.contracted:
        first, last = np.maximum(region.low, FAR)[:2], np.minimum(region.high, 1 - FAR)[:2]
        middle = 0.5
    else:
        first = np.maximum(region.low[:2], low / space.half[:2])
        last = np.minimum(region.high[:2], high / space.half[:2])
        middle = 0.0
    if not (first < last).all():
        return np.zeros((0, 2))
    step = np.linspace(0, 1, STEPS + 1 if space.contracted else 2)[:-1, None]
    corners = np.array([first, (last[0], first[1]), last, (first[0], last[1])])
    ring = np.concatenate([a + step * (b - a) for a, b in zip(corners, np.roll(corners, -1, 0))])
    world = space.world(np.column_stack([ring, np.full(len(ring), middle)]))
    along = _clipped((world - space.origin) @ space.rotation[:2].T, low, high)
    return space.map(space.origin + along @ space.rotation[:2])


def centroid(ring):
    """float64[2], the centre of area of a polygon float64[K, 2]."""
    a = ring - ring[0]  # far from the origin, products of coordinates would lose their digits
    b = np.roll(a, -1, 0)
    cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return ring[0] + cross @ (a + b) / (3 * cross.sum())


def _clipped(polygon, low, high):
    """The part of a polygon float64[K, 2] inside a rectangle (Sutherland and Hodgman 1974)."""
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


def geojson(partition, scene, facts=()):
    """A dict, GeoJSON's FeatureCollection: a polygon a block and a point a camera, on the map.

    Coordinates are those of `Space.map`, world units, no geographic ones. facts: of each block a
    dict of more properties, such as its number of gaussians. Endless cells end a little beyond
    everything else.
    """
    low, high = extent(partition, scene)
    features = []
    for block, (region, views) in enumerate(zip(partition.regions, partition.views)):
        ring = outline(region, low, high)
        rings = [[*ring.tolist(), ring[0].tolist()]] if len(ring) else []
        features.append(_feature("Polygon", rings, {
            "block": block, "views": len(views), **(facts[block] if facts else {})}))
    blocks = np.zeros(len(scene.views), int)
    for views in partition.views:
        blocks[views] += 1
    for index, view in enumerate(scene.views):
        place = partition.space.map(world_of(scene, view.camera.position))[0]
        features.append(_feature("Point", place.tolist(), {
            "view": view.name, "blocks": int(blocks[index]),
            **({"dropped": partition.dropped[index]} if index in partition.dropped else {})}))
    return {"type": "FeatureCollection", "features": features}


def _feature(kind, coordinates, properties):
    return {"type": "Feature", "geometry": {"type": kind, "coordinates": coordinates},
            "properties": properties}
