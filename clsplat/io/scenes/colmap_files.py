"""The files of a COLMAP sparse model, binary and text.

Only what training needs is read: cameras, poses, points and their tracks. pycolmap would read all
observations, keep a Python object for each point, and end the process on some damaged files.
Format: https://colmap.github.io/format.html.
"""

import codecs
import mmap
import struct
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.errors import reason
from clsplat.io.atomic import replacing
from clsplat.io.regular import open_regular, read_regular
from clsplat.scene import View, rows_by_view

PARTS = ("cameras", "images", "points3D")
# COLMAP's camera models in the order of their numbers, and how many parameters each has
CAMERA_MODELS = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12,
    "FOV": 5,
    "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5,
    "THIN_PRISM_FISHEYE": 12,
    "RAD_TAN_THIN_PRISM_FISHEYE": 16,
    "SIMPLE_DIVISION": 4,
    "DIVISION": 5,
    "SIMPLE_FISHEYE": 3,
    "FISHEYE": 4,
    "EUCM": 6,
    "EQUIRECTANGULAR": 2,
}
PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE")
_CAMERA = struct.Struct("<IiQQ")  # id, model, width, height; then the parameters
_IMAGE = struct.Struct("<I7dI")  # id, quaternion (wxyz), translation, camera's id; then the name
_OBSERVATION = np.dtype([("pixel", "<f8", 2), ("point", "<u8")])  # of a point in an image
_POINT = np.dtype(
    [("id", "<u8"), ("position", "<f8", 3), ("colour", "u1", 3), ("error", "<f8"), ("length", "<u8")]
)  # then the track
_LENGTH = struct.Struct("<Q")
_TRACK = np.dtype([("image", "<u4"), ("observation", "<u4")])
POINTS_AT_ONCE = 1 << 16  # that are written


class Camera(NamedTuple):
    """A camera: its id, the name of its model, its size and its parameters in pixels."""

    number: int
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
    """N points in the order of the file, and the observations in their tracks: the row of a point
    and the id of an image each."""

    ids: NDArray[np.int64]
    positions: NDArray[np.float64]
    colours: NDArray[np.uint8]
    rows: NDArray[np.int64]
    images: NDArray[np.int64]


def read_part(path: Path, part: str) -> Any:
    """Read one of PARTS, .bin or .txt: a list of cameras or images, or Points; an error of any kind
    if the file is damaged or cannot be read, see `fields.reading`."""
    return (_read_binary if path.suffix == ".bin" else _read_text)(path, part)


def _read_binary(path: Path, part: str) -> Any:
    with open_regular(path) as file:
        data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    (count,) = _LENGTH.unpack_from(data)
    return _BINARY[part](data, count)


def _binary_cameras(data: mmap.mmap, count: int) -> list[Camera]:
    cameras: list[Camera] = []
    position, models = 8, list(CAMERA_MODELS.items())
    for _ in range(count):
        number, model, width, height = _CAMERA.unpack_from(data, position)
        if not 0 <= model < len(models):
            raise ValueError(f"camera {number} has a model that COLMAP does not have ({model})")
        name, parameters = models[model]
        position += _CAMERA.size
        cameras.append(Camera(number, name, width, height, struct.unpack_from(f"<{parameters}d", data, position)))
        position += 8 * parameters
    return cameras


def _binary_images(data: mmap.mmap, count: int) -> list[Image]:
    images, position = [], 8
    for _ in range(count):
        number, *pose, camera = _IMAGE.unpack_from(data, position)
        begin = position + _IMAGE.size
        end = data.find(b"\0", begin)
        (observed,) = _LENGTH.unpack_from(data, end + 1)
        position = end + 9 + _OBSERVATION.itemsize * observed
        if end < 0 or position > len(data):
            raise ValueError(f"its bytes are too few for {count} images")
        images.append(Image(number, pose[:4], pose[4:], camera, data[begin:end].decode()))
    return images


def _binary_points(data: mmap.mmap, count: int) -> Points:
    lengths, end, length_at = [], 8, _LENGTH.unpack_from
    for _ in range(count):  # of millions: no more than says where the next one begins
        end += _POINT.itemsize
        (length,) = length_at(data, end - _LENGTH.size)
        end += _TRACK.itemsize * length
        if end > len(data):
            raise ValueError(f"its bytes are too few for {count} points")
        lengths.append(length)
    tracks = np.array(lengths, np.int64)
    sizes = np.stack([np.full(count, _POINT.itemsize), _TRACK.itemsize * tracks], axis=1)
    in_track = np.repeat(np.tile([False, True], count), sizes.ravel())
    records = np.frombuffer(data, np.uint8, end - 8, 8)
    points = records[~in_track].view(_POINT)
    return Points(
        points["id"].astype(np.int64),
        points["position"],
        points["colour"],
        np.repeat(np.arange(count), tracks),
        records[in_track].view(_TRACK)["image"].astype(np.int64),
    )


_BINARY: dict[str, Callable[[mmap.mmap, int], Any]] = {
    "cameras": _binary_cameras,
    "images": _binary_images,
    "points3D": _binary_points,
}


def _read_text(path: Path, part: str) -> Any:
    data = read_regular(path).removeprefix(codecs.BOM_UTF8)
    if b"\0" in data:
        raise ValueError("not a text file")
    if b"# Number of" in data and not data.endswith(b"\n"):  # COLMAP ends the last line, too
        raise ValueError("cut short: its last line has no line end (add one if the file is whole)")
    rows: list[Any] = []
    lines = enumerate(data.splitlines(), 1)
    for number, line in lines:
        if not line.strip() or line.lstrip().startswith(b"#"):
            continue
        try:
            rows.append(_TEXT[part](line))
            if part == "images":
                _check_observations(next(lines, (0, b""))[1].split())
        except (ValueError, IndexError, OverflowError) as error:
            raise ValueError(f"line {number}: {reason(error)}") from None
    if part != "points3D":
        return rows
    ids, positions, colours, tracks = zip(*rows) if rows else ((), (), (), ())
    return Points(
        np.array(ids, np.int64),
        np.array(positions, np.float64).reshape(-1, 3),
        np.frombuffer(b"".join(colours), np.uint8).reshape(-1, 3),
        np.repeat(np.arange(len(rows)), np.array(list(map(len, tracks)), np.int64)),
        np.array([image for track in tracks for image in track], np.int64),
    )


def _text_camera(line: bytes) -> Camera:
    number, model, width, height, *parameters = line.split()
    name = model.decode(errors="replace")
    if len(parameters) != CAMERA_MODELS.get(name):
        raise ValueError(f"{name[:40]!r} with {len(parameters)} parameters is not a camera model")
    return Camera(_id(number), name, int(width), int(height), tuple(map(float, parameters)))


def _text_image(line: bytes) -> Image:
    # a name may contain spaces: COLMAP writes them, though it reads names up to the first one
    fields = line.strip().split(maxsplit=9)
    if len(fields) != 10:
        raise ValueError(f"an image has {len(fields)} fields")
    number, *words, camera, name = fields
    pose = tuple(map(float, words))
    return Image(_id(number), pose[:4], pose[4:], _id(camera), name.decode())


def _check_observations(fields: Sequence[bytes]) -> None:
    """ValueError unless these are rows of x, y and the id of a point: programs leave out the line
    of an image that has no observations."""
    if len(fields) % 3 or fields and not fields[-1].removeprefix(b"-").isdigit():
        raise ValueError(
            "the next line is not its observations: each image has two lines, of which the second may be empty"
        )


def _id(text: bytes, bits: int = 32) -> int:
    number = int(text)
    if not 0 <= number < 1 << bits:
        raise ValueError(f"an id is not a number of {bits} bits")
    return number


def _text_point(line: bytes) -> tuple[int, list[float], bytes, list[int]]:
    """The id, the position, the colour and the images of the track."""
    fields = line.split()
    if len(fields) < 8 or len(fields) % 2:
        raise ValueError(f"a point has {len(fields)} numbers")
    return (
        _id(fields[0], 63),
        list(map(float, fields[1:4])),
        bytes(map(int, fields[4:7])),
        list(map(_id, fields[8::2])),
    )


_TEXT: dict[str, Callable[[bytes], Any]] = {"cameras": _text_camera, "images": _text_image, "points3D": _text_point}


def write_colmap(
    folder: Path,
    views: Sequence[View],
    points: NDArray[np.float64],
    colours: NDArray[np.uint8],
    observations: NDArray[np.integer] | None = None,
    pixels: NDArray[np.float64] | None = None,
) -> None:
    """Write cameras.bin, images.bin and points3D.bin into a folder, which is created if missing.

    Ids count from 1 in the order of the arguments; the errors of points are unknown.

    Parameters
    ----------
    views : those with equal intrinsics share a camera.
    points, colours : float64[N, 3], world, and uint8[N, 3].
    observations : int[M, 2], rows (point, view); None: no point is seen.
    pixels : float64[M, 2], where the points were seen; None: where they project to.
    """
    point, view = np.zeros((2, 0), int) if observations is None else observations.T
    # the rows of observations of each view, each of which then is a keypoint of its image
    of_views = rows_by_view(view, len(views))
    if pixels is None:
        pixels = np.empty((len(point), 2))
        for each, rows in zip(views, of_views):
            pixels[rows], _ = each.camera.project(points[point[rows]])
    track = np.empty(len(point), _TRACK)
    track["image"] = view + 1
    for rows in of_views:
        track["observation"][rows] = np.arange(len(rows))
    lengths = np.bincount(point, minlength=len(points))
    heads = np.zeros(len(points), _POINT)
    heads["id"], heads["position"] = np.arange(1, len(points) + 1), points
    heads["colour"], heads["error"], heads["length"] = colours, -1, lengths
    if (np.diff(point) < 0).any():
        track = track[np.argsort(point, kind="stable")]
    intrinsics = [(each.camera.width, each.camera.height, *each.camera.focal, *each.camera.centre) for each in views]
    cameras = {each: number for number, each in enumerate(dict.fromkeys(intrinsics), 1)}
    pinhole = list(CAMERA_MODELS).index("PINHOLE")
    folder.mkdir(parents=True, exist_ok=True)
    for name, count, records in (
        (
            "cameras",
            len(cameras),
            (
                _CAMERA.pack(number, pinhole, width, height) + struct.pack("<4d", *parameters)
                for (width, height, *parameters), number in cameras.items()
            ),
        ),
        (
            "images",
            len(views),
            (
                _image(number, each, cameras[intrinsics[number - 1]], pixels[rows], point[rows])
                for number, (each, rows) in enumerate(zip(views, of_views), 1)
            ),
        ),
        ("points3D", len(points), _point_records(heads, track)),
    ):
        with replacing(folder / f"{name}.bin") as file:
            file.write(_LENGTH.pack(count))
            file.writelines(records)


def _point_records(heads: NDArray[Any], track: NDArray[Any]) -> Iterator[bytes]:
    """The records of points [N], each with its part of the track [M], many at a time: a call for
    each of some millions of points would take a minute."""
    ends = np.cumsum(heads["length"], dtype=np.int64)
    for first in range(0, len(heads), POINTS_AT_ONCE):
        some = heads[first : first + POINTS_AT_ONCE]
        lengths = some["length"].astype(np.int64)
        end = ends[first + len(some) - 1]
        sizes = _POINT.itemsize + _TRACK.itemsize * lengths
        begins = np.cumsum(sizes) - sizes
        data = np.empty(sizes.sum(), np.uint8)
        is_head = np.zeros(len(data), bool)
        is_head[begins[:, None] + np.arange(_POINT.itemsize)] = True
        data[is_head] = some.view(np.uint8)
        data[~is_head] = track[end - lengths.sum() : end].view(np.uint8)
        yield data.tobytes()


def _image(number: int, view: View, camera: int, pixels: NDArray[np.float64], points: NDArray[np.integer]) -> bytes:
    """The record of a view with its observations."""
    x, y, z, w = scipy.spatial.transform.Rotation.from_matrix(view.camera.rotation).as_quat()
    seen = np.empty(len(points), _OBSERVATION)
    seen["pixel"], seen["point"] = pixels, points + 1
    return (
        _IMAGE.pack(number, w, x, y, z, *view.camera.translation, camera)
        + view.name.encode()
        + b"\0"
        + _LENGTH.pack(len(points))
        + seen.tobytes()
    )
