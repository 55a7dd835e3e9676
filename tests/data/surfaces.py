"""Surfaces of analytic shape as GeoTIFF, and GeoJSON of lines and polygons on them."""

import json

import numpy as np
import rasterio

CRS, LEFT, TOP = "EPSG:32633", 400_000.0, 5_700_000.0
PIXEL, SIDE = 0.15, 400  # metres; pixels along a side
MIDDLE = np.array([LEFT, TOP]) + PIXEL * SIDE / 2 * np.array([1, -1])
RADIUS, HEIGHT = 12.0, 4.0  # of a heap


def places(pixel=PIXEL, side=SIDE):
    """x and y of pixels' centres, from MIDDLE."""
    steps = (np.arange(side) + 0.5) * pixel
    return np.meshgrid(LEFT + steps - MIDDLE[0], TOP - steps - MIDDLE[1])


def heap(x, y, radius=RADIUS, height=HEIGHT):
    """A paraboloid, whose volume is pi/2 radius² height."""
    return height * np.maximum(0, 1 - (x**2 + y**2) / radius**2)


HEAP_VOLUME = np.pi / 2 * RADIUS**2 * HEIGHT


def write_surface(path, heights, crs=CRS, pixel=PIXEL, left=LEFT, top=TOP, **options):
    heights = np.asarray(heights)
    heights = heights[None] if heights.ndim == 2 else heights
    options = {"dtype": "float32", "nodata": np.nan, **options}
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        count=len(heights),
        height=heights.shape[1],
        width=heights.shape[2],
        crs=crs,
        transform=rasterio.Affine(pixel, 0, left, 0, -pixel, top),
        **options,
    ) as file:
        file.write(heights.astype(options["dtype"]))
    return path


def circle(radius, count=400, middle=MIDDLE):
    turns = np.linspace(0, 2 * np.pi, count + 1)
    turns[-1] = 0
    return (middle + radius * np.column_stack([np.cos(turns), np.sin(turns)])).tolist()


def square(half, middle=MIDDLE):
    corners = half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    return (middle + corners).tolist()


def feature(kind, coordinates, name=None):
    return {
        "type": "Feature",
        "properties": {} if name is None else {"name": name},
        "geometry": {"type": kind, "coordinates": coordinates},
    }


def write_features(path, *features, **members):
    table = {"type": "FeatureCollection", "features": list(features), **members}
    path.write_text(json.dumps(table))
    return path
