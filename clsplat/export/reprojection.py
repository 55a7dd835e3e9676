"""Between the coordinate reference systems (CRS) of a scene, of its map and of GeoJSON."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.errors import InputError
from clsplat.io.georeference.crs import SHOWN, heights_of, map_crs, on_ground
from clsplat.io.reason import clean


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
    clsplat.ClsplatError : the wanted one is unknown, not projected with metres as its unit, or has
        another vertical part than the scene's, as heights are not converted.
    """
    crs = map_crs(wanted)
    vertical, known = heights_of(crs).name, heights_of(own).name
    if vertical and vertical != known:
        raise InputError(f"--crs {clean(wanted)[:SHOWN]}: its heights count from {vertical}, those "
                         f"of the scene from {known or 'what its georeference does not name'}, and "
                         "heights are not converted; name the horizontal system alone")
    return None if crs == own else Reprojection(own, crs)
