"""A map as an item of a SpatioTemporal Asset Catalog (STAC 1.1), by which catalogues find it."""

from collections.abc import Mapping
from datetime import datetime, timedelta
from typing import Any

import numpy as np

from clsplat.apps.map_grid import MapGrid
from clsplat.io.georeference.crs import WGS84, on_ground

PROJECTION = "https://stac-extensions.github.io/projection/v2.0.0/schema.json"
COG, PNG = "image/tiff; application=geotiff; profile=cloud-optimized", "image/png"
GEOJSON, XML, PDF = "application/geo+json", "application/xml", "application/pdf"
DEGREE_DIGITS = 8  # after the point: a millimetre
# of a clock whose zone is unknown: the farthest zones from UTC are 14 hours before and 12 after it
BEFORE, AFTER = timedelta(hours=14), timedelta(hours=12)
# of a file: its media type, what it is for, its title
Asset = tuple[str, str, str]


def stac_item(
    name: str,
    grid: MapGrid,
    period: tuple[datetime, datetime],
    assets: Mapping[str, Asset],
    bands: Mapping[str, list[dict[str, Any]]],
    record: Mapping[str, Any],
) -> dict[str, Any]:
    """The item of a map, with relative references.

    Parameters
    ----------
    name : the identifier of the map.
    grid : of its rasters.
    period : when the first and the last photo were taken; without a time zone the item has an
        interval in which that surely was.
    assets : by the names of files that a map may have.
    bands : of its rasters, as STAC has them.
    record : of the map, which has a CRS.
    """
    crs: str = record["crs"]
    left, bottom, right, top = grid.bounds
    corners = [(left, bottom), (right, bottom), (right, top), (left, top), (left, bottom)]
    ring = np.round(on_ground(crs, WGS84, [(*corner, 0) for corner in corners])[:, :2], DEGREE_DIGITS)
    first, last = period
    known = first.tzinfo is not None
    if not known:
        first, last = first - BEFORE, last + AFTER
    start, end = (each.strftime("%Y-%m-%dT%H:%M:%SZ") for each in (first, last))
    size = grid.resolution
    return {
        "type": "Feature",
        "stac_version": "1.1.0",
        "stac_extensions": [PROJECTION],
        "id": name,
        "geometry": {"type": "Polygon", "coordinates": [ring.tolist()]},
        "bbox": [*ring.min(axis=0).tolist(), *ring.max(axis=0).tolist()],
        "properties": {
            "datetime": start if known else None,
            "start_datetime": start,
            "end_datetime": end,
            **({"proj:code": None, "proj:wkt2": crs} if "[" in crs else {"proj:code": crs}),
            "proj:bbox": list(grid.bounds),
            "proj:shape": [grid.rows, grid.columns],
            "proj:transform": [size, 0, left, 0, -size, top],
            "title": f"Map of {name}",
            "gsd": record["ground_sampling_distance"],
            "clsplat:vertical_reference": record["vertical_reference"],
        },
        "links": [],
        "assets": {
            file.replace(".", "_"): {
                "href": f"./{file}",
                "type": kind,
                "roles": [role],
                "title": title,
                **({"bands": bands[file]} if file in bands else {"proj:code": WGS84 if kind == GEOJSON else None}),
            }
            for file, (kind, role, title) in assets.items()
            if file in record["files"]
        },
    }
