"""From the earth to a map: reconstructions in geocentric coordinates.

A reconstruction is rigid, a map is not: near one place a map is a similarity of the earth up to
its curvature, which over a kilometre makes centimetres. So a scene is moved to the map by the
similarity at the middle of its cameras, and what it misses is stated as the residual.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsplat.georeference import Georeference
from clsplat.io.georeference.crs import GEOCENTRIC, GEODETIC, converter, utm_zone
from clsplat.placement.similarity import Similarity

STEP = 50.0  # metres, over which the map is differentiated


def topocentric(latitude: float, longitude: float, height: float) -> Similarity:
    """From east, north and up in metres at a place (degrees, metres) to geocentric coordinates."""
    (centre,) = converter(GEODETIC, GEOCENTRIC)([(longitude, latitude, height)])
    (sin_lat, sin_lon), (cos_lat, cos_lon) = (
        function(np.radians([latitude, longitude])) for function in (np.sin, np.cos))
    axes = np.array([[-sin_lon, -sin_lat * cos_lon, cos_lat * cos_lon],
                     [cos_lon, -sin_lat * sin_lon, cos_lat * sin_lon],
                     [0.0, cos_lat, sin_lat]])
    return Similarity(1.0, axes, centre)


def on_map(to_earth: Similarity, centres: NDArray[np.float64], crs: str, source: str
           ) -> tuple[Similarity, Georeference]:
    """Find how a reconstruction lies on a map.

    Parameters
    ----------
    to_earth : from the reconstruction's coordinates to geocentric ones (WGS 84, metres).
    centres : [V, 3], of the cameras, in the reconstruction's coordinates.
    crs : a projected CRS in metres; "": the UTM zone of the cameras.
    source : of the georeference.

    Returns
    -------
    The similarity to the scene's original coordinates (east, north, up in metres), and their
    georeference; its offset is a place near the cameras, in whole metres.

    Raises
    ------
    ValueError : if the cameras are not near the earth's surface, or outside of the map.
    """
    middle = np.median(centres, axis=0)
    geodetic = converter(GEOCENTRIC, GEODETIC)
    (place,) = geodetic(to_earth(middle[None]))
    if not (np.isfinite(place).all() and abs(place[2]) < 1e5):
        raise ValueError("its cameras are not near the earth's surface")
    crs = crs or utm_zone(place[0], place[1])
    projected = converter(GEODETIC, crs)

    def to_map(points: NDArray[np.float64]) -> NDArray[np.float64]:
        return projected(geodetic(to_earth(points)))

    steps = STEP / to_earth.scale * np.eye(3)
    columns = (to_map(middle + steps) - to_map(middle - steps)) * to_earth.scale / (2 * STEP)
    exact, (centre,) = to_map(centres), to_map(middle[None])
    if not (np.isfinite(exact).all() and np.isfinite(centre).all() and np.isfinite(columns).all()):
        raise ValueError(f"its cameras are outside of {crs[:80]}")
    left, sizes, right = np.linalg.svd(columns.T)
    scale, rotation = float(sizes.mean()), left @ right
    if np.linalg.det(rotation) < 0:
        raise ValueError("its coordinates are mirrored")
    offset = np.round(centre)
    similarity = Similarity(scale, rotation, centre - offset - scale * rotation @ middle)
    missed = similarity(centres) + offset - exact
    residual = float(np.sqrt((missed**2).sum(axis=1).mean()))
    east, north, height = offset.tolist()
    return similarity, Georeference(crs, (east, north, height), source, residual)
