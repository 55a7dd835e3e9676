"""What a COLMAP sparse model holds, in its binary and in its text form.

Only what training needs: cameras, poses, points and their tracks. What images observe is passed
over, and so are rigs and frames, since images hold their own poses. Format:
https://colmap.github.io/format.html.
"""

from typing import NamedTuple

import numpy as np

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
    """A camera model's name, its size and parameters in pixels."""

    model: str
    width: int
    height: int
    parameters: tuple


class Image(NamedTuple):
    """An image by its number; quaternion (wxyz) and translation from world to camera."""

    number: int
    quaternion: tuple
    translation: tuple
    camera: int
    name: str


class Points(NamedTuple):
    """Points in the order of the file.

    ids: int64[N]; positions: float64[N, 3]; colours: uint8[N, 3]; lengths: int64[N], of their
    tracks; images: int64[M], numbers of the images of all tracks, one track after the other.
    """

    ids: np.ndarray
    positions: np.ndarray
    colours: np.ndarray
    lengths: np.ndarray
    images: np.ndarray


def places_within(lengths):
    """int[sum of lengths]: 0, 1, ... within each of runs of these lengths, one after the other."""
    return np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths)
