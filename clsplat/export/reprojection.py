"""Between the coordinate reference systems (CRS) of a scene, of its map and of GeoJSON."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.io.georeference.crs import map_crs, on_ground


@dataclass(frozen=True)
class Reprojection:
    """From the CRS of a scene to another one and back; heights stay as they are.

    Attributes
    ----------
    scene_crs, map_crs : as `io.georeference.crs.normal_crs` returns them.
    """

    scene_crs: str
    map_crs: str

    def to_map(self, points: ArrayLike) -> NDArray[np.float64]:
        """Points float[N, 3] of the scene's CRS in the map's."""
        return on_ground(self.scene_crs, self.map_crs, points)

    def to_scene(self, points: ArrayLike) -> NDArray[np.float64]:
        """Points float[N, 3] of the map's CRS in the scene's."""
        return on_ground(self.map_crs, self.scene_crs, points)


def reprojection_of(own: str, wanted: str) -> Reprojection | None:
    """From a scene's CRS to the one that its map shall have; None if they are the same.

    Raises
    ------
    clsplat.ClsplatError : the wanted one is unknown, or not projected with metres as its unit.
    """
    crs = map_crs(wanted)
    return None if crs == own else Reprojection(own, crs)


def epsg_code(crs: str) -> int | None:
    """The EPSG code of a CRS; None if it has none."""
    match = re.fullmatch(r"EPSG:(\d{1,5})", crs)
    return int(match[1]) if match else None
