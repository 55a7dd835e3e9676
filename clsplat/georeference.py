"""The place of a scene on the earth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class Georeference:
    """The coordinate reference system (CRS) of a scene.

    A georeferenced scene has axes east, north and up in metres. Its files, and those of models
    trained on it, hold small numbers: map coordinates are `offset` + original coordinates. Only
    formats with room for large numbers (GeoTIFF, LAS) contain the offset.

    Attributes
    ----------
    crs : a projected CRS in metres, as "EPSG:32614" or WKT2.
    offset : (east, north, height), metres: map coordinates of the original origin.
    source : what it was computed from, such as "GPS of 40 photos".
    residual : metres, the root mean square (RMS) distance between what was computed and the source.
    """

    crs: str
    offset: tuple[float, float, float]
    source: str
    residual: float

    def to_map(self, points: ArrayLike) -> NDArray[np.float64]:
        """Map coordinates float64[N, 3] of points float[N, 3] in original coordinates."""
        return np.asarray(points, np.float64) + self.offset

    def from_map(self, points: ArrayLike) -> NDArray[np.float64]:
        """Original coordinates float64[N, 3] of points float[N, 3] in map coordinates."""
        return np.asarray(points, np.float64) - self.offset
