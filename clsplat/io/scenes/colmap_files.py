"""The files of a COLMAP sparse model, binary and text.

Only what training needs is read: cameras, poses, points and their tracks. pycolmap would read all
observations, keep a Python object for each point, and end the process on some damaged files.
Format: https://colmap.github.io/format.html.
"""

import codecs
import mmap
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from clsplat.io.atomic import replacing
from clsplat.io.reason import reason
from clsplat.io.regular import open_regular, read_regular
from clsplat.scene import View

PARTS = ("cameras", "images", "points3D")
# COLMAP's camera models in the order of their numbers, and how many parameters each has
CAMERA_MODELS = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8,
    "OPENCV_FISHEYE": 8, "FULL_OPENCV": 12, "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12, "RAD_TAN_THIN_PRISM_FISHEYE": 16,
    "SIMPLE_DIVISION": 4, "DIVISION": 5, "SIMPLE_FISHEYE": 3, "FISHEYE": 4, "EUCM": 6,
    "EQUIRECTANGULAR": 2}
PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE")
CAMERA = struct.Struct("<IiQQ")  # id, model, width, height; then the parameters
IMAGE = struct.Struct("<I7dI")  # id, quaternion (wxyz), translation, camera's id; then the name
OBSERVATION = np.dtype([("pixel", "<f8", 2), ("point", "<u8")])  # of a point in an image
POINT = np.dtype([("id", "<u8"), ("position", "<f8", 3), ("colour", "u1", 3), ("error", "<f8"),
                  ("length", "<u8")])  # then the track
TRACK_LENGTH = struct.Struct("<Q")
TRACK = np.dtype([("image", "<u4"), ("observation", "<u4")])


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
    """N points in the order of the file: `lengths` [N] are those of their tracks, and `images` the
    image ids of all tracks, one track after the other."""

    ids: NDArray[np.int64]
    positions: NDArray[np.float64]
    colours: NDArray[np.uint8]
    lengths: NDArray[np.int64]
    images: NDArray[np.int64]


def places_within(lengths: NDArray[np.int64]) -> NDArray[np.int64]:
    """Count from 0 within consecutive groups of these lengths: 2, 3 give 0, 1, 0, 1, 2."""
    return np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths)


def read_part(path: Path, part: str) -> Any:
    """Read one of PARTS, .bin or .txt: a list of cameras or images, or Points; ValueError if the
    file is damaged, OSError if it cannot be read."""
    return (_read_binary if path.suffix == ".bin" else _read_text)(path, part)


def _read_binary(path: Path, part: str) -> Any:
    with open_regular(path) as file:
        size = file.seek(0, 2)
        if size < 8:
            raise ValueError(f"empty or cut short ({size} bytes)")
        data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    count = struct.unpack_from("<Q", data)[0]
    try:
        return BINARY[part](data, count)
    except (struct.error, IndexError, OverflowError):
        raise ValueError(f"cut short ({size} bytes are too few for its {count} {part})") from None


def _binary_cameras(data: mmap.mmap, count: int) -> list[Camera]:
    cameras: list[Camera] = []
    position, models = 8, list(CAMERA_MODELS.items())
    for _ in range(count):
        number, model, width, height = CAMERA.unpack_from(data, position)
        if not 0 <= model < len(models):
            raise ValueError(f"camera {number} has a model that COLMAP does not have ({model})")
        name, parameters = models[model]
        position += CAMERA.size
        cameras.append(Camera(number, name, width, height,
                              struct.unpack_from(f"<{parameters}d", data, position)))
        position += 8 * parameters
    return cameras


def _binary_images(data: mmap.mmap, count: int) -> list[Image]:
    images, position = [], 8
    for _ in range(count):
        number, *pose, camera = IMAGE.unpack_from(data, position)
        begin = position + IMAGE.size
        end = data.find(b"\0", begin)
        if end < 0:
            raise IndexError
        try:
            name = data[begin:end].decode()
        except UnicodeDecodeError:
            raise ValueError(f"the name of image {number} is not UTF-8") from None
        observed, = struct.unpack_from("<Q", data, end + 1)
        position = end + 9 + OBSERVATION.itemsize * observed
        images.append(Image(number, pose[:4], pose[4:], camera, name))
    if position > len(data):
        raise IndexError
    return images


def _binary_points(data: mmap.mmap, count: int) -> Points:
    begins, position, before = [], 8, POINT.itemsize - 8
    for _ in range(count):
        begins.append(position)
        position += POINT.itemsize + TRACK.itemsize * TRACK_LENGTH.unpack_from(
            data, position + before)[0]
    if position > len(data):
        raise IndexError
    content, places = np.frombuffer(data, np.uint8), np.array(begins, np.int64)
    points = _records(content, places, POINT)
    lengths = points["length"].astype(np.int64)
    tracks = _records(content, np.repeat(places + POINT.itemsize, lengths)
                      + TRACK.itemsize * places_within(lengths), TRACK)
    return Points(points["id"].astype(np.int64), points["position"], points["colour"], lengths,
                  tracks["image"].astype(np.int64))


def _records(data: NDArray[np.uint8], places: NDArray[np.int64], dtype: np.dtype[Any]
             ) -> NDArray[Any]:
    """The records of `dtype` that begin at these bytes of `data`."""
    rows: NDArray[Any] = data[places[:, None] + np.arange(dtype.itemsize)].view(dtype)
    return rows.reshape(len(places))


BINARY: dict[str, Callable[[mmap.mmap, int], Any]] = {
    "cameras": _binary_cameras, "images": _binary_images, "points3D": _binary_points}


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
            rows.append(TEXT[part](line))
            if part == "images":
                _check_observations(next(lines, (0, b""))[1].split())
        except (ValueError, IndexError, OverflowError) as error:
            raise ValueError(f"line {number} is damaged ({reason(error)})") from None
    if part != "points3D":
        return rows
    ids, positions, colours, tracks = zip(*rows) if rows else ((), (), (), ())
    return Points(np.array(ids, np.int64), np.array(positions, np.float64).reshape(-1, 3),
                  np.array(colours, np.uint8).reshape(-1, 3),
                  np.array(list(map(len, tracks)), np.int64),
                  np.array([image for track in tracks for image in track], np.int64))


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
        raise ValueError("the next line is not its observations: each image has two lines, of "
                         "which the second may be empty")


def _id(text: bytes) -> int:
    number = int(text)
    if not 0 <= number < 1 << 32:
        raise ValueError("an id is not a number of 32 bits")
    return number


def _text_point(line: bytes) -> tuple[int, list[float], list[int], list[int]]:
    """The id, the position, the colour and the images of the track."""
    fields = line.split()
    if len(fields) < 8 or len(fields) % 2:
        raise ValueError(f"a point has {len(fields)} numbers")
    colour = list(map(int, fields[4:7]))
    if not all(0 <= each <= 255 for each in colour):
        raise ValueError("a colour is not within 0 to 255")
    return int(fields[0]), list(map(float, fields[1:4])), colour, list(map(int, fields[8::2]))


TEXT: dict[str, Callable[[bytes], Any]] = {
    "cameras": _text_camera, "images": _text_image, "points3D": _text_point}


@dataclass(frozen=True, eq=False)
class Tracks:
    """Observations of points in views.

    Attributes
    ----------
    points, views : int[M], indices into the model's points and views.
    pixels : float64[M, 2], where the point appears in the view.
    """

    points: NDArray[np.integer]
    views: NDArray[np.integer]
    pixels: NDArray[np.float64]


def write_colmap(folder: str | Path, views: Sequence[View], points: NDArray[np.float64],
                 colours: NDArray[np.uint8], tracks: Tracks) -> None:
    """Write cameras.bin, images.bin and points3D.bin into a folder, which is created if missing.

    Ids count from 1 in the order of the arguments; the error of a point is the mean distance in
    pixels between its projections and its observations.

    Parameters
    ----------
    views : those with equal intrinsics share a camera.
    points : float64[N, 3], world.
    colours : uint8[N, 3].
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    intrinsics = [(view.camera.width, view.camera.height, *view.camera.focal, *view.camera.centre)
                  for view in views]
    camera_ids = {each: number for number, each in enumerate(dict.fromkeys(intrinsics), 1)}
    by_view = [np.flatnonzero(tracks.views == i) for i in range(len(views))]
    cameras = (CAMERA.pack(number, list(CAMERA_MODELS).index("PINHOLE"), width, height)
               + struct.pack("<4d", *parameters)
               for (width, height, *parameters), number in camera_ids.items())
    for name, count, chunks in (
            ("cameras", len(camera_ids), cameras),
            ("images", len(views), _images(views, [camera_ids[each] for each in intrinsics],
                                           tracks, by_view)),
            ("points3D", len(points), _written_points(views, points, colours, tracks, by_view))):
        with replacing(folder / f"{name}.bin") as file:
            file.write(struct.pack("<Q", count))
            file.writelines(chunks)


def _images(views: Sequence[View], cameras: Sequence[int], tracks: Tracks,
            by_view: Sequence[NDArray[Any]]) -> Iterator[bytes]:
    for number, (view, camera, rows) in enumerate(zip(views, cameras, by_view), 1):
        x, y, z, w = Rotation.from_matrix(view.camera.rotation).as_quat()
        seen = np.empty(len(rows), OBSERVATION)
        seen["pixel"], seen["point"] = tracks.pixels[rows], tracks.points[rows] + 1
        yield (IMAGE.pack(number, w, x, y, z, *view.camera.translation, camera)
               + view.name.encode() + b"\0" + struct.pack("<Q", len(rows)) + seen.tobytes())


def _written_points(views: Sequence[View], points: NDArray[np.float64],
                    colours: NDArray[np.uint8], tracks: Tracks, by_view: Sequence[NDArray[Any]]
                    ) -> Iterator[bytes]:
    keypoint = np.empty(len(tracks.points), int)  # the index of an observation in its image
    error = np.empty(len(tracks.points))
    for view, rows in zip(views, by_view):
        keypoint[rows] = np.arange(len(rows))
        pixels, _ = view.camera.project(points[tracks.points[rows]])
        error[rows] = np.linalg.norm(pixels - tracks.pixels[rows], axis=1)
    order = np.argsort(tracks.points, kind="stable")
    seen = np.empty(len(order), TRACK)
    seen["image"], seen["observation"] = tracks.views[order] + 1, keypoint[order]
    begins, ends = np.searchsorted(
        tracks.points[order], [np.arange(len(points)), np.arange(1, len(points) + 1)])
    head = np.zeros(len(points), POINT)
    head["id"], head["position"] = np.arange(1, len(points) + 1), points
    head["colour"], head["length"] = colours, ends - begins
    head["error"] = [error[order[begin:end]].mean() if end > begin else -1.0  # COLMAP: unknown
                     for begin, end in zip(begins, ends)]
    for row, begin, end in zip(head, begins, ends):
        yield row.tobytes() + seen[begin:end].tobytes()
