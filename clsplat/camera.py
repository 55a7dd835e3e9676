"""Pinhole cameras, the lenses of photos that are undistorted to theirs, and orthographic cameras.

Conventions, used everywhere: camera axes are right, down, forward (COLMAP); the centre of pixel
(0, 0) is at (0.5, 0.5); quaternions are wxyz; `x_camera = rotation @ x_world + translation`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from clsplat.errors import InputError

MOST_PIXELS = 1 << 16  # of a side
LEAST_FOCAL, MOST_FOCAL = 1e-6, 1e9  # pixels, or pixels a world unit; squares fit float32
SHOWN = 80  # characters of a value in a message


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera with a pose from world to camera, a pinhole unless it is orthographic.

    Attributes
    ----------
    width, height : size of the image, pixels.
    focal : (fx, fy), pixels.
    centre : the principal point (cx, cy), pixels.
    rotation : float64[3, 3], from the world to the camera.
    translation : float64[3], in the camera's frame.
    whole : (left, top, right, bottom), the borders of the whole photo in pixels of this image, if
        this is a part of it, such as (-100, 0, 540, 480); None: the image is the whole photo.
    offset : float64[3], the origin of its world in original coordinates.
    orthographic : whether all rays are parallel to the axis, as in a map; `focal` is then in pixels
        a world unit, whatever the depth.
    """

    width: int
    height: int
    focal: tuple[float, float]
    centre: tuple[float, float]
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    whole: tuple[float, float, float, float] | None = None
    offset: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    orthographic: bool = False

    def check(self) -> None:
        """Raise a ClsplatError if no picture can be drawn with these numbers."""
        for name in ("width", "height"):
            side = getattr(self, name)
            if isinstance(side, bool) or not (isinstance(side, (int, np.integer)) and 0 < side <= MOST_PIXELS):
                raise InputError(f"{name} {side!r}: expects a whole number of pixels from 1 to {MOST_PIXELS:,}")
        for name, shape in (
            ("focal", (2,)),
            ("centre", (2,)),
            ("rotation", (3, 3)),
            ("translation", (3,)),
            ("offset", (3,)),
        ):
            numbers(name, getattr(self, name), shape)
        if not all(LEAST_FOCAL <= each <= MOST_FOCAL for each in self.focal):
            raise InputError(f"focal {self.focal}: expects pixels from {LEAST_FOCAL:g} to {MOST_FOCAL:g}")
        if not np.allclose(self.rotation @ np.transpose(self.rotation), np.eye(3), atol=1e-3):
            raise InputError("rotation: its rows are not orthogonal unit vectors; give a rotation")
        if np.linalg.det(self.rotation) < 0:
            raise InputError(
                "rotation: is a mirror image (its determinant is -1); turn one of its "
                "axes, so that they are right, down and forward"
            )

    @classmethod
    def looking_at(
        cls,
        target: ArrayLike,
        position: ArrayLike,
        *,
        up: ArrayLike = (0, 0, 1),
        width: int = 640,
        height: int = 480,
        degrees: float = 60.0,
    ) -> Camera:
        """A camera at a position that looks at a target.

        Parameters
        ----------
        target : float[3], world: the point in the middle of the image.
        position : float[3], world: the optical centre.
        up : float[3], world: the direction that is upwards in the image.
        width, height : size of the image, pixels.
        degrees : horizontal field of view.

        Raises
        ------
        clsplat.ClsplatError : if target, position and up do not define a rotation.
        """
        centre = np.asarray(position, np.float64)
        forward = np.asarray(target, np.float64) - centre
        right = np.cross(forward, np.asarray(up, np.float64))
        lengths = np.linalg.norm(forward), np.linalg.norm(right)
        if not (min(lengths) > 1e-12 * max(1.0, float(np.linalg.norm(up))) * lengths[0]):
            raise InputError(
                "the camera's target is at its position, or straight up or down from it; give another `up`"
            )
        forward, right = forward / lengths[0], right / lengths[1]
        rotation = np.stack([right, np.cross(forward, right), forward])
        focal = width / (2 * np.tan(np.radians(degrees) / 2))
        return cls(width, height, (float(focal), float(focal)), (width / 2, height / 2), rotation, -rotation @ centre)

    def __repr__(self) -> str:
        place = ", ".join(f"{value:.4g}" for value in self.position)
        return f"<clsplat.Camera {self.width} x {self.height}, focal length {self.focal[0]:.4g}, at ({place})>"

    @property
    def borders(self) -> tuple[float, float, float, float]:
        """(left, top, right, bottom), the borders of the whole photo in pixels of this image."""
        return self.whole or (0.0, 0.0, float(self.width), float(self.height))

    @property
    def position(self) -> NDArray[np.float64]:
        """float64[3], the optical centre in the world frame."""
        return -self.rotation.T @ self.translation

    def resized(self, width: int, height: int) -> Camera:
        """The same camera for an image of another size; each axis has its own scale.

        Parameters
        ----------
        width, height : pixels.
        """
        sx, sy = width / self.width, height / self.height
        whole = self.whole and tuple(np.multiply(self.whole, (sx, sy, sx, sy)).tolist())
        return replace(
            self,
            width=width,
            height=height,
            focal=(self.focal[0] * sx, self.focal[1] * sy),
            centre=(self.centre[0] * sx, self.centre[1] * sy),
            whole=whole,
        )

    def cropped(self, left: int, top: int, right: int, bottom: int) -> Camera:
        """The same camera for a part of its image.

        Parameters
        ----------
        left, top, right, bottom : borders of the part, pixels; the last two are exclusive.
        """
        return replace(
            self,
            width=right - left,
            height=bottom - top,
            centre=(self.centre[0] - left, self.centre[1] - top),
            whole=tuple(np.subtract(self.borders, [left, top, left, top]).tolist()),
        )

    def turned(self, quarters: int) -> Camera:
        """The same camera for its image after clockwise quarter turns.

        Parameters
        ----------
        quarters : how many, 0 to 3.
        """
        if not quarters:
            return self
        turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        left, top, right, bottom = self.borders
        whole = None if self.whole is None else (self.height - bottom, left, self.height - top, right)
        return replace(
            self,
            width=self.height,
            height=self.width,
            focal=self.focal[::-1],
            centre=(self.height - self.centre[1], self.centre[0]),
            whole=whole,
            rotation=turn @ self.rotation,
            translation=turn @ self.translation,
        ).turned(quarters - 1)

    def reduced(self, downscale: float, max_resolution: float = 0) -> Camera:
        """The same camera for a smaller image, whose sides are rounded down.

        Parameters
        ----------
        downscale : width and height are divided by this.
        max_resolution : pixels, the longest side of the whole photo after this; 0: any.
        """
        left, top, right, bottom = self.borders
        factor = max(downscale, max(right - left, bottom - top) / (max_resolution or np.inf))
        # rounding may leave the longest side a digit below the whole number that was asked for
        width, height = (max(1, int(side / factor + 1e-9)) for side in (self.width, self.height))
        return self.resized(width, height)

    def shifted(self, offset: ArrayLike) -> Camera:
        """The same camera in a world with another origin.

        Parameters
        ----------
        offset : float64[3], world: the new origin.
        """
        away = np.asarray(offset, np.float64)
        return replace(self, translation=self.translation + self.rotation @ away, offset=self.offset + away)

    def moved(self, turn: ArrayLike, shift: ArrayLike) -> Camera:
        """The same camera with another pose.

        Parameters
        ----------
        turn : float[3], radians; a rotation vector in the axes of this camera, by which all that it
            sees turns about its centre.
        shift : float[3], world units; by which its centre moves, in the axes of this camera.
        """
        turned = scipy.spatial.transform.Rotation.from_rotvec(np.asarray(turn, np.float64)).as_matrix()
        return replace(
            self,
            rotation=turned @ self.rotation,
            translation=turned @ (self.translation - np.asarray(shift, np.float64)),
        )

    def project(self, points: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The pixels float64[N, 2] to which points float64[N, 3], world, project, and their depths
        float64[N] along the camera's axis."""
        p = turned(self.rotation, points) + self.translation[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            pixel = p[:2] / (1.0 if self.orthographic else p[2])
            pixel *= np.array(self.focal)[:, None]
            pixel += np.array(self.centre)[:, None]
        return pixel.T, p[2]

    def shows(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Which points float64[N, 3], world, lie in front of it and within the image, bool[N]."""
        pixels, depths = self.project(points)
        return (depths > 0) & self.contains(pixels)

    def contains(self, pixels: NDArray[np.floating], beyond: ArrayLike = 0.0) -> NDArray[np.bool_]:
        """Which pixels [N, 2] lie within the image, or up to `beyond` pixels ([N] or one number)
        outside of it, as bool[N]."""
        (x, y), beyond = pixels.T, np.asarray(beyond)
        inside: NDArray[np.bool_] = (
            (x > -beyond) & (x < self.width + beyond) & (y > -beyond) & (y < self.height + beyond)
        )
        return inside


def numbers(name: str, values: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Finite real numbers of a shape; InputError, which begins with `name`, for anything else."""
    try:
        if np.iscomplexobj(values):
            raise ValueError
        array = np.asarray(values, np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{name} {shown(values)}: expects numbers") from None
    if array.shape != shape or not np.isfinite(array).all():
        size = " x ".join(map(str, shape)) + " finite numbers" if shape else "a finite number"
        raise InputError(f"{name} {shown(values)}: expects {size}")
    return array


def shown(value: object) -> str:
    """A value of the user in a message: the beginning of its text, in one line."""
    return " ".join(str(value).split())[:SHOWN]


def turned(rotation: NDArray[np.float64], points: ArrayLike) -> NDArray[np.float64]:
    """Points float64[N, 3] after a rotation float64[3, 3], one coordinate after the other: [3, N].

    Operations on long rows are several times as fast as on rows of three numbers, and no BLAS is
    used, whose threads would wait busily for the next product.
    """
    columns = np.ascontiguousarray(np.asarray(points, np.float64).T)
    result: NDArray[np.float64] = np.einsum("ij,jn->in", rotation, columns)
    return result


@dataclass(frozen=True, eq=False)
class Lens:
    """How the stored photo of a view differs from a pinhole camera's (io/photos/lenses.py)."""

    model: str  # COLMAP's name of the camera model, such as OPENCV
    # (width, height), pixels, of the stored photo for which the parameters hold
    size: tuple[int, int]
    parameters: tuple[float, ...]  # in COLMAP's order, pixels
    # float64[3, 3], from the undistorted camera's frame to that of the stored photo
    rotation: NDArray[np.float64]
    # width, height, focal, centre: the pinhole camera of the whole undistorted photo, pixels
    width: int
    height: int
    focal: tuple[float, float]
    centre: tuple[float, float]

    def resized(self, scale_x: float, scale_y: float) -> Lens:
        """The same lens with an undistorted photo whose sides are multiplied by these factors, up
        to rounding to whole pixels."""
        width, height = max(1, round(self.width * scale_x)), max(1, round(self.height * scale_y))
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            focal=(self.focal[0] * sx, self.focal[1] * sy),
            centre=(self.centre[0] * sx, self.centre[1] * sy),
        )
