"""The binary form of a COLMAP sparse model; see `colmap_format`.

Records have no fixed size, so they are read one by one, and a count that is too large for the file
is detected.
"""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.io.regular import open_regular
from clsplat.io.scenes.colmap_format import CAMERA_MODELS, Camera, Image, Points, places_within

CAMERA = struct.Struct("<IiQQ")  # id, model, width, height; then the parameters
IMAGE = struct.Struct("<I7dI")  # id, quaternion (wxyz), translation, camera's id; then the name
OBSERVATION_BYTES = 24  # of a point in an image: x, y, point's id
POINT = np.dtype([("id", "<u8"), ("position", "<f8", 3), ("colour", "u1", 3), ("error", "<f8"),
                  ("length", "<u8")])  # then the track
TRACK = np.dtype([("image", "<u4"), ("observation", "<u4")])


def read_binary(path: Path, part: str) -> Any:
    """Read one of `colmap_format.PARTS`: cameras by id, a list of images, or Points; ValueError if
    the file is damaged."""
    with open_regular(path) as file:
        size = file.seek(0, 2)
        if size < 8:
            raise ValueError(f"empty or cut short ({size} bytes)")
        data: NDArray[np.uint8] = np.memmap(file, np.uint8, "r")
    count = struct.unpack_from("<Q", data.data)[0]
    try:
        return READERS[part](data, count)
    except (struct.error, IndexError, OverflowError):
        raise ValueError(f"cut short ({size} bytes are too few for its {count} {part})") from None


def _read_cameras(data: NDArray[np.uint8], count: int) -> dict[int, Camera]:
    cameras: dict[int, Camera] = {}
    position, models = 8, list(CAMERA_MODELS.items())
    for _ in range(count):
        number, model, width, height = CAMERA.unpack_from(data.data, position)
        if not 0 <= model < len(models):
            raise ValueError(f"camera {number} has a model that COLMAP does not have ({model})")
        if number in cameras:
            raise ValueError(f"camera {number} occurs twice")
        name, parameters = models[model]
        position += CAMERA.size
        cameras[number] = Camera(
            name, width, height, struct.unpack_from(f"<{parameters}d", data.data, position))
        position += 8 * parameters
    return cameras


def _read_images(data: NDArray[np.uint8], count: int) -> list[Image]:
    images, position = [], 8
    for _ in range(count):
        number, *pose, camera = IMAGE.unpack_from(data.data, position)
        begin = position + IMAGE.size
        end = _end_of_text(data, begin)
        observed, = struct.unpack_from("<Q", data.data, end + 1)
        position = end + 9 + OBSERVATION_BYTES * observed
        images.append(Image(number, pose[:4], pose[4:], camera, _text(data[begin:end], number)))
    if position > len(data):
        raise IndexError
    return images


def _end_of_text(data: NDArray[np.uint8], begin: int) -> int:
    """The position of the zero byte that ends a text; IndexError if it is missing."""
    length = 256
    while True:
        end = bytes(data[begin:begin + length]).find(b"\0")
        if end >= 0:
            return begin + end
        if begin + length >= len(data):
            raise IndexError
        length *= 16


def _text(data: NDArray[np.uint8], number: int) -> str:
    try:
        return bytes(data).decode()
    except UnicodeDecodeError:
        raise ValueError(f"the name of image {number} is not UTF-8") from None


def _read_points(data: NDArray[np.uint8], count: int) -> Points:
    begins, position = [], 8
    track, before, view = struct.Struct("<Q"), POINT.itemsize - 8, data.data
    for _ in range(count):
        begins.append(position)
        position += POINT.itemsize + TRACK.itemsize * track.unpack_from(view, position + before)[0]
    if position > len(data):
        raise IndexError
    places = np.array(begins, np.int64)
    points = _records(data, places, POINT)
    lengths = points["length"].astype(np.int64)
    firsts = places + POINT.itemsize
    tracks = _records(
        data, np.repeat(firsts, lengths) + TRACK.itemsize * places_within(lengths), TRACK)
    return Points(points["id"].astype(np.int64), points["position"], points["colour"], lengths,
                  tracks["image"].astype(np.int64))


def _records(data: NDArray[np.uint8], places: NDArray[np.int64], dtype: np.dtype[Any]
             ) -> NDArray[Any]:
    """The records of `dtype` that begin at these bytes of `data`."""
    rows: NDArray[Any] = data[places[:, None] + np.arange(dtype.itemsize)].view(dtype)
    return rows.reshape(len(places))


READERS: dict[str, Callable[[NDArray[np.uint8], int], Any]] = {
    "cameras": _read_cameras, "images": _read_images, "points3D": _read_points}
