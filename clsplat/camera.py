"""Pinhole cameras.

Conventions, used everywhere: camera axes are right, down, forward (COLMAP); the centre of pixel
(0, 0) is at (0.5, 0.5); quaternions are wxyz; `x_camera = rotation @ x_world + translation`.
"""

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera with a pose.

    width, height: image size, pixels. focal: (fx, fy), pixels. centre: principal point (cx, cy),
    pixels. rotation: float64[3, 3], world to camera. translation: float64[3], camera frame. whole:
    (left, top, right, bottom), pixels of this image: the borders of the photo that it is a part of,
    such as (-100, 0, 540, 480); None: the image is all of the photo.
    """

    width: int
    height: int
    focal: tuple[float, float]
    centre: tuple[float, float]
    rotation: np.ndarray
    translation: np.ndarray
    whole: tuple[float, float, float, float] | None = None

    @property
    def borders(self):
        """(left, top, right, bottom), pixels of this image: where the whole photo ends."""
        return self.whole or (0.0, 0.0, float(self.width), float(self.height))

    @property
    def position(self):
        """float64[3], the optical centre in the world frame."""
        return -self.rotation.T @ self.translation

    def resized(self, width, height):
        """The same camera for an image of width x height pixels (each axis scaled by itself)."""
        sx, sy = width / self.width, height / self.height
        whole = self.whole and tuple(np.multiply(self.whole, (sx, sy, sx, sy)).tolist())
        return replace(
            self, width=width, height=height,
            focal=(self.focal[0] * sx, self.focal[1] * sy),
            centre=(self.centre[0] * sx, self.centre[1] * sy), whole=whole)

    def cropped(self, left, top, right, bottom):
        """The same camera for the part of its image between these columns and rows."""
        away = np.array([left, top])
        return replace(
            self, width=right - left, height=bottom - top,
            centre=tuple((self.centre - away).tolist()),
            whole=tuple((np.array(self.borders) - [*away, *away]).tolist()))

    def reduced(self, downscale, max_resolution=0):
        """The same camera for an image `downscale` times smaller, sides rounded down; the longer
        side of the whole photo then is at most `max_resolution` pixels (0: any)."""
        left, top, right, bottom = self.borders
        factor = max(downscale, max(right - left, bottom - top) / (max_resolution or np.inf))
        return self.resized(max(1, int(self.width / factor)), max(1, int(self.height / factor)))

    def shifted(self, offset):
        """The same camera in a world whose origin was moved to `offset` (float64[3], world)."""
        return replace(self, translation=self.translation + self.rotation @ np.asarray(offset))

    def project(self, points):
        """Pixel coordinates float64[N, 2] and depths float64[N] of world points [N, 3]."""
        p = np.asarray(points, np.float64) @ self.rotation.T + self.translation
        with np.errstate(divide="ignore", invalid="ignore"):
            pixel = p[:, :2] / p[:, 2:] * self.focal + self.centre
        return pixel, p[:, 2]


def scene_extent(cameras):
    """1.1 x the largest distance of a camera from the mean camera position (Kerbl et al. 2023).

    World units. It scales position learning rates and the size thresholds of densification.
    """
    positions = np.array([camera.position for camera in cameras])
    return 1.1 * float(np.linalg.norm(positions - positions.mean(0), axis=1).max())
