"""Finds a COLMAP model and checks that its files are whole, before pycolmap sees them.

pycolmap reads past the end of a binary file that was cut short: it then aborts the process, or
returns wrong cameras without a word. Walking the records by their sizes costs little and tells
which file is to blame. Formats: https://colmap.github.io/format.html.
"""

import mmap
import struct
from pathlib import Path

from clsplat.errors import InputError
from clsplat.io.regular import open_regular, read_regular

PARTS = ("cameras", "images", "points3D")
CAMERA_BYTES = 24  # id, model, width, height
IMAGE_BYTES = 64  # id, quaternion, translation, camera id
POINT_BYTES = 51  # id, position, colour, error, track length
RIG_BYTES = 8  # id, number of sensors
SENSOR_BYTES = 8  # type, id; all but the first: whether a pose follows, and the pose
POSE_BYTES = 56
FRAME_BYTES = 68  # id, rig, pose, number of data
DATUM_BYTES = 16  # sensor type, sensor id, id
# parameters of COLMAP's camera models by number; later ones are left to pycolmap
PARAMETERS = (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12)


def find_model(folder):
    """The folder of the sparse model of a scene folder: sparse/0, sparse, or the folder itself,
    else the one of most images below sparse/."""
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give a scene folder with images and sparse/0")
    for model in (folder / "sparse" / "0", folder / "sparse", folder):
        if _is_model(model):
            return model
    others = _numbered_models(folder)
    if others:
        return max(others, key=registered)
    raise InputError(f"{folder}: no COLMAP model in sparse/0, sparse or the folder itself; make "
                     "one with COLMAP or pycolmap (recipe: docs/photos.md), or give another folder")


def model_notes(folder, model):
    """Lines about the models of a scene folder that are not used."""
    others = [other for other in _numbered_models(Path(folder)) if other != model]
    largest = max(others, key=registered, default=None)
    if model.parent.name != "sparse" or largest is None and model.name == "0":
        return
    used = f"the model sparse/{model.name} is used, with {registered(model)} images"
    if largest is None:
        yield f"{used}: there is no sparse/0"
    elif registered(largest) > registered(model):
        yield (f"{used}, and sparse/{largest.name} has {registered(largest)}: COLMAP has split the "
               f"scene; to train the larger part, move it to sparse/0 of a folder of its own")
    elif model.name != "0":
        yield f"{used}: the largest of {len(others) + 1} below sparse/, where there is no sparse/0"


def _is_model(folder):
    return any((folder / f"{part}.{kind}").exists() for part in PARTS for kind in ("bin", "txt"))


def _numbered_models(folder):
    """The models sparse/N of a scene folder, by number."""
    found = (path for path in (folder / "sparse").glob("*") if path.name.isdecimal())
    return sorted((path for path in found if _is_model(path)), key=lambda path: int(path.name))


def registered(model):
    """How many images a model says it has; 0 where it is damaged."""
    try:
        if (model / "images.bin").exists():
            with open_regular(model / "images.bin") as file:
                return struct.unpack("<Q", file.read(8))[0]
        lines = read_regular(model / "images.txt").splitlines()
        # two a photo, of which the second may be empty
        return -(-sum(not line.startswith(b"#") for line in lines) // 2)
    except (OSError, struct.error):
        return 0


def check_files(model, may_be_empty=()):
    """InputError unless the three files of the model are there, and they and those of rigs and
    frames, which COLMAP has had since 3.12, are not empty and not cut short; may_be_empty: parts
    that may hold nothing, such as points3D of views that are only for testing."""
    kind = "bin" if any((model / f"{part}.bin").exists() for part in PARTS) else "txt"
    for part, walk in WALKS.items():
        path = model / f"{part}.{kind}"
        if not path.exists():
            if part not in PARTS:
                continue
            raise InputError(f"{path}: missing from the COLMAP model; copy the whole model")
        try:
            if kind == "bin":
                _check_binary(path, part, walk, part in may_be_empty)
            else:
                _check_text(path, part, part in may_be_empty)
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror}); check its permissions"
                             ) from None


def _check_binary(path, part, walk, may_be_empty):
    size = path.stat().st_size
    if size < 8:
        raise InputError(f"{path}: empty or cut short ({size} bytes); copy the model again")
    with open_regular(path) as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        count = struct.unpack_from("<Q", data)[0]
        if count == 0 and not may_be_empty:
            raise InputError(f"{path}: holds no {part}; reconstruct the scene again")
        try:
            end = walk(data, count)
        except (struct.error, IndexError, OverflowError):
            end = size + 1
    if end > size:
        raise InputError(f"{path}: cut short ({size} bytes are too few for its {count} {part}); "
                         "copy the model again")


def _walk_cameras(data, count):
    position = 8
    for _ in range(count):
        number = struct.unpack_from("<i", data, position + 4)[0]
        if not 0 <= number < len(PARAMETERS):
            return position
        position += CAMERA_BYTES + 8 * PARAMETERS[number]
    return position


def _walk_images(data, count):
    position = 8
    for _ in range(count):
        end = data.find(b"\0", position + IMAGE_BYTES)
        if end < 0:
            raise IndexError
        position = end + 9 + 24 * struct.unpack_from("<Q", data, end + 1)[0]
    return position


def _walk_points(data, count):
    position, track = 8, struct.Struct("<Q")
    for _ in range(count):
        position += POINT_BYTES + 8 * track.unpack_from(data, position + POINT_BYTES - 8)[0]
    return position


def _walk_rigs(data, count):
    position = 8
    for _ in range(count):
        sensors = struct.unpack_from("<I", data, position + 4)[0]
        position += RIG_BYTES + SENSOR_BYTES * min(sensors, 1)
        for _ in range(sensors - 1):
            position += SENSOR_BYTES + 1 + POSE_BYTES * (data[position + SENSOR_BYTES] != 0)
    return position


def _walk_frames(data, count):
    position, number = 8, struct.Struct("<I")
    for _ in range(count):
        data_count = number.unpack_from(data, position + FRAME_BYTES - 4)[0]
        position += FRAME_BYTES + DATUM_BYTES * data_count
    return position


WALKS = {"cameras": _walk_cameras, "images": _walk_images, "points3D": _walk_points,
         "rigs": _walk_rigs, "frames": _walk_frames}
# text: the field of a line that counts what follows; COLMAP reads so many, there or not
COUNT_FIELDS = {"rigs": 1, "frames": 9}


def _check_text(path, part, may_be_empty):
    filled = made_by_colmap = False
    line = b""
    with open_regular(path) as file:
        for line in file:
            if b"\0" in line:
                raise InputError(f"{path}: not a text file; copy the model again")
            made_by_colmap |= line.startswith(b"# Number of")
            if line.strip() and not line.lstrip().startswith(b"#"):
                filled = True
                _check_count(path, line.split(), COUNT_FIELDS.get(part))
    if not (filled or may_be_empty):
        raise InputError(f"{path}: holds no {part}; copy the model again, or reconstruct the scene")
    if made_by_colmap and not line.endswith(b"\n"):
        raise InputError(f"{path}: cut short: its last line has no end; copy the model again, "
                         "or end that line if you know it is whole")


def _check_count(path, fields, place):
    """InputError where a line says that more follows than it holds."""
    if place is None:
        return
    try:
        whole = 0 <= int(fields[place]) < len(fields)
    except (ValueError, IndexError):
        whole = False
    if not whole:
        raise InputError(f"{path}: a line's count does not fit what follows it; "
                         "copy the model again")
