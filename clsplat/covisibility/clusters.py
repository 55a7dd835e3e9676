"""Points in clusters, so that a view is compared with those that it may show."""

import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.camera import Camera, turned

CLUSTER = 256  # points that a view is compared with together
ROUNDING = 1e-6  # of the lengths compared: a cluster is never missed by it


class Clusters:
    """Equal numbers of points that lie close together, with spheres around them.

    `positions` : [N, 3]; those that are not finite are in no view; `order` : int[N], the points by
    their clusters."""

    def __init__(self, positions: NDArray[np.floating]) -> None:
        count = len(positions)
        finite = np.isfinite(positions).all(axis=1, keepdims=True)
        self.order = scipy.spatial.cKDTree(np.where(finite, positions, 0), CLUSTER, compact_nodes=False).indices
        self._count, starts = count, np.arange(0, count, CLUSTER)
        packed = np.where(finite, positions, np.nan)[self.order]
        low, high = (end.reduceat(packed, starts) if count else packed for end in (np.fmin, np.fmax))
        self._centres = (low.astype(np.float64) + high) / 2
        self._radii = np.linalg.norm(high - low, axis=1) / 2

    def near_view(self, camera: Camera, near: float, beside: float = 0.0) -> NDArray[np.integer]:
        """The places in `order` of points that a view may show; all others it certainly does not.

        `camera` : a pinhole, in the frame of the points; `near` : depth of the near plane; `beside`
        : pixels outside of the image that count, too."""
        centres = turned(camera.rotation, self._centres) + camera.translation[:, None]
        (fx, fy), (cx, cy) = camera.focal, camera.centre
        sides = np.array(
            [
                (fx, 0, beside + cx),
                (-fx, 0, beside + camera.width - cx),
                (0, fy, beside + cy),
                (0, -fy, beside + camera.height - cy),
            ]
        )
        inside = np.einsum("ij,jn->in", sides, centres)
        inside += np.linalg.norm(sides, axis=1)[:, None] * self._radii
        rounding = ROUNDING * np.einsum("ij,jn->in", abs(sides), abs(centres))
        shown = (inside > -rounding).all(axis=0)
        shown &= centres[2] + self._radii > near - ROUNDING * abs(centres[2])
        rows = (np.flatnonzero(shown)[:, None] * CLUSTER + np.arange(CLUSTER)).ravel()
        found: NDArray[np.integer] = rows[: np.searchsorted(rows, self._count)]  # the last has fewer
        return found
