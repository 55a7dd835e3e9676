"""The content of a COLMAP sparse model, in its binary and in its text form.

Only what training needs is read: cameras, poses, points and their tracks. The observations of
images are skipped, and so are rigs and frames, since images hold their own poses. Format:
https://colmap.github.io/format.html.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

PARTS = ("cameras", "images", "points3D")
# COLMAP's camera models in the order of their numbers, and how many parameters each has
CAMERA_MODELS = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8,
    "OPENCV_FISHEYE": 8, "FULL_OPENCV": 12, "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12, "RAD_TAN_THIN_PRISM_FISHEYE": 16,
    "SIMPLE_DIVISION": 4, "DIVISION": 5, "SIMPLE_FISHEYE": 3, "FISHEYE": 4, "EUCM": 6,
    "EQUIRECTANGULAR": 2}
PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE")


class Camera(NamedTuple):
    """A camera: the name of its model, its size and its parameters in pixels."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


class Image(NamedTuple):
    """A registered image: its id, its pose from world to camera (wxyz) and the camera's id."""

    number: int
    quaternion: Sequence[float]
    translation: Sequence[float]
    camera: int
    name: str


class Points(NamedTuple):
    """Points in the order of the file.

    Attributes
    ----------
    ids : int64[N].
    positions : float64[N, 3], world.
    colours : uint8[N, 3].
    lengths : int64[N], of the points' tracks.
    images : int64[M], the image ids of all tracks, one track after the other.
    """

    ids: NDArray[np.int64]
    positions: NDArray[np.float64]
    colours: NDArray[np.uint8]
    lengths: NDArray[np.int64]
    images: NDArray[np.int64]


def places_within(lengths: NDArray[np.int64]) -> NDArray[np.int64]:
    """Count from 0 within consecutive groups of these lengths: 2, 3 give 0, 1, 0, 1, 2."""
    return np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths)
