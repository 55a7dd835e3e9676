"""Points in clusters of neighbours; a view is compared with few of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import turned

if TYPE_CHECKING:
    from clsplat.camera import Camera

SIZE = 256  # points of a cluster
ROUNDING = 1e-6  # of the lengths compared: a cluster is never missed by it


class Clusters:
    """Equal numbers of points that lie close together, with spheres around them.

    They are cut across the two longest sides of all points: into strips, and these into clusters
    (the packing of R-trees of Leutenegger, Lopez and Edgington 1997, Sort-Tile-Recursive).
    `positions` : [N, 3]; those that are not finite are in no view; `reach` : [N], how far each of
    the points extends; `order` : int[N], the points in the order of their clusters."""

    def __init__(self, positions: NDArray[np.floating], reach: NDArray[np.floating]) -> None:
        count = len(positions)
        positions = np.where(np.isfinite(positions), positions, np.nan)
        low, high = (each.reduce(positions, axis=0, initial=np.nan) for each in (np.fmin, np.fmax))
        across, along = np.argsort(low - high)[:2]  # the longest sides first
        strips = max(1, round((count / SIZE) ** 0.5))
        rank = np.empty(count, np.int64)
        rank[np.argsort(positions[:, across], kind="stable")] = np.arange(count)
        strip = rank * strips // max(count, 1)
        there_and_back = np.where(strip % 2, -1, 1)  # so that clusters of two strips are small, too
        self.order = np.lexsort((there_and_back * positions[:, along], strip))
        starts = np.arange(0, count, SIZE)
        self._cluster = np.arange(count) // SIZE
        packed = positions[self.order]
        low, high = (each.reduceat(packed, starts, axis=0) if count else packed
                     for each in (np.fmin, np.fmax))
        self._centres = (low.astype(np.float64) + high) / 2
        self._radii = np.linalg.norm(high - low, axis=1) / 2
        self._reaches = np.maximum.reduceat(reach[self.order], starts) if count else reach

    def near_view(self, camera: Camera, near: float, beside: float = 0.0
                  ) -> NDArray[np.integer]:
        """The places in `order` of points that a view may show; all others it certainly does not.

        `camera` : a pinhole, in the frame of the points; `near` : depth of the near plane; `beside`
        : pixels outside of the image that count, too."""
        x, y, z = turned(camera.rotation, self._centres) + camera.translation[:, None]
        (fx, fy), (cx, cy) = camera.focal, camera.centre
        shown = z + self._radii > near - ROUNDING * abs(z)
        # a point at the pixel u = fx x / z + cx reaches the image if u > -max(fx, fy) reach / z
        for focal, place, from_left, length in ((fx, x, cx, camera.width),
                                                (fy, y, cy, camera.height)):
            for sign, centre in ((1, beside + from_left),
                                 (-1, beside + length - from_left)):
                inside = sign * focal * place + centre * z
                slack = (np.hypot(focal, centre) * self._radii + max(fx, fy) * self._reaches
                         + ROUNDING * (focal * abs(place) + abs(centre * z)))
                shown &= inside + slack > 0
        found: NDArray[np.integer] = np.flatnonzero(shown[self._cluster])
        return found
