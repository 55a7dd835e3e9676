"""Brown's lens model with a radial term of r^8, which no camera model of COLMAP has.

nerfstudio, Metashape and RealityScan call its coefficient k4; that of COLMAP's FULL_OPENCV is
another, which divides.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

NAME = "BROWN_K4"  # of the model, in place of one of COLMAP
ROUNDS, SMALLEST_STEP = 30, 1e-12  # of Newton's method


class Brown:
    """A camera with this model; as much of pycolmap.Camera as io/photos/lenses.py uses.

    Parameters
    ----------
    parameters : fx, fy, cx, cy, k1, k2, k3, k4, p1, p2; pixels.
    """

    def __init__(self, parameters: Sequence[float]) -> None:
        values = np.array(parameters, np.float64)
        self._focal, self._centre = values[:2], values[2:4]
        self._radial, self._tangential = values[4:8], values[8:]

    def img_from_cam(self, rays: NDArray[np.float64], check_cheirality: bool = False
                     ) -> NDArray[np.float64]:
        """Pixels float64[N, 2] of rays float64[N, 3], which are in front of the camera."""
        with np.errstate(all="ignore"):
            distorted, _ = self._distorted(rays[:, :2] / rays[:, 2:])
            return distorted * self._focal + self._centre

    def cam_ray_from_img(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Unit rays float64[N, 3] of pixels float64[N, 2]; of no meaning where there is none."""
        with np.errstate(all="ignore"):
            wanted = (pixels - self._centre) / self._focal
            places = wanted.copy()
            for _ in range(ROUNDS):
                found, slopes = self._distorted(places)
                (a, b), (_, d) = slopes  # symmetric
                x, y = (wanted - found).T
                step = np.stack([d * x - b * y, a * y - b * x], axis=1) / (a * d - b * b)[:, None]
                places += step
                if not (np.abs(step) > SMALLEST_STEP).any():
                    break
            rays = np.column_stack([places, np.ones(len(places))])
            unit: NDArray[np.float64] = rays / np.linalg.norm(rays, axis=1, keepdims=True)
            return unit

    def _distorted(self, places: NDArray[np.float64]
                   ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Where x/z and y/z [N, 2] appear, and the derivatives float64[2, 2, N]."""
        (x, y), (k1, k2, k3, k4), (p1, p2) = places.T, self._radial, self._tangential
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
        slope = 2 * (k1 + r2 * (2 * k2 + r2 * (3 * k3 + r2 * 4 * k4)))
        both = slope * x * y + 2 * (p1 * x + p2 * y)
        return np.stack([x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                         y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)], axis=1), np.array([
            [radial + slope * x * x + 2 * p1 * y + 6 * p2 * x, both],
            [both, radial + slope * y * y + 6 * p1 * y + 2 * p2 * x]])
