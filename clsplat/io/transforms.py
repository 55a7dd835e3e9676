"""Reads transforms.json: instant-ngp's and nerfstudio's, and MatrixCity's (Li et al. 2023).

Poses are camera to world with camera axes right, up, back. MatrixCity has two kinds of file. Its
splits (transforms_train.json, transforms_test.json) are in units of 100 m. What it exported from
Unreal Engine has frames with `rot_mat`, rotations divided by 100 and positions in metres, and
`frame_index`, the photo's name: it is brought to the units of the splits, so that their point
clouds fit (authors' answer in city-super/MatrixCity, issue 9). Keys that are not read, such as
aabb_scale, describe no camera.
"""

from os.path import isfile
from pathlib import Path, PurePosixPath

import numpy as np

from clsplat.errors import InputError
from clsplat.io.checks import CONTROL
from clsplat.io.cloud import read_cloud
from clsplat.io.images import image_size
from clsplat.io.posed import PosedPhoto, posed_scene
from clsplat.io.reason import reason
from clsplat.io.records import object_of
from clsplat.io.regular import native, read_regular

WHOLE, TRAIN, TEST = "transforms.json", "transforms_train.json", "transforms_test.json"
SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".PNG")  # tried where file_path has none
DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "FULL_OPENCV", "SIMPLE_RADIAL", "RADIAL")
MATRIXCITY_UNIT = 100.0  # metres
LONGEST_SIDE = 1 << 20  # pixels


def has_transforms(folder):
    """Whether a folder's photos are described by transforms.json or transforms_train.json, and not
    by a COLMAP model of its own, which has tracks."""
    model = ("sparse", "cameras.bin", "cameras.txt")
    return (any((folder / name).is_file() for name in (TRAIN, WHOLE))
            and not any((folder / name).exists() for name in model))


def read_transforms(folder):
    """The scene of a folder with transforms_train.json and, held out, transforms_test.json, or
    with transforms.json alone; recentred.

    Photos are where file_path says, from the folder; a view's name is that path without "..".
    Points: `ply_file_path`, else see `cloud.read_cloud`, else drawn. Lens distortion, and whatever
    cannot be trained on, raises InputError.
    """
    folder = Path(folder)
    path = folder / (TRAIN if (folder / TRAIN).exists() else WHOLE)
    table = _table(path)
    shots = _shots(path, table, False)
    if path.name == TRAIN and (folder / TEST).exists():
        shots += _shots(folder / TEST, _table(folder / TEST), True)
    return posed_scene(path, folder, shots, _cloud(path, table))


def _table(path):
    try:
        table = object_of(read_regular(path))
        if not isinstance(table.get("frames"), list) or not table["frames"]:
            raise ValueError("it has no frames")
        return table
    except (ValueError, OSError) as error:
        raise InputError(f"{path}: not a transforms.json, or damaged ({reason(error)}); "
                         "export or copy it again") from None


def _shots(path, table, held_out):
    shots = []
    for number, frame in enumerate(table["frames"]):
        try:
            shots.append(_shot(path.parent, {**table, **frame}, held_out))
        except (ValueError, TypeError, OverflowError, OSError) as error:
            raise InputError(f"{path}: frame {number} is damaged ({reason(error)}); "
                             "export it again") from None
    return shots


def _shot(folder, frame, held_out):
    """A frame, with what the file says of all; InputError for a lens that is no pinhole."""
    pose, photo = _pose(frame)
    name, source = _photo(folder, photo)
    _check_lens(source, frame)
    if "w" in frame and "h" in frame:
        size = _side(frame, "w"), _side(frame, "h")
    else:
        size = image_size(source)
    focal_x = _focal(frame, "fl_x", "camera_angle_x", size[0])
    focal_y = _focal(frame, "fl_y", "camera_angle_y", size[1], focal_x)
    centre = (_number(frame, "cx", size[0] / 2), _number(frame, "cy", size[1] / 2))
    return PosedPhoto(name, source, size, (focal_x, focal_y), centre, pose, held_out)


def _pose(frame):
    """(float64[3, 4], path of the photo)."""
    if "rot_mat" not in frame:
        return _matrix(frame, "transform_matrix"), frame.get("file_path")
    pose = _matrix(frame, "rot_mat")
    pose[:, :3] *= MATRIXCITY_UNIT
    pose[:, 3] /= MATRIXCITY_UNIT
    return pose, f"{_number(frame, 'frame_index'):04.0f}.png"


def _matrix(table, key):
    matrix = np.array(table.get(key), np.float64)
    if matrix.shape not in ((3, 4), (4, 4)):
        raise ValueError(f"{key} is no matrix of 3 or 4 rows of 4")
    return matrix[:3]


def _photo(folder, photo):
    """(name of the view, path) of a photo that may lack its suffix."""
    photo = _text(photo, "file_path").replace("\\", "/")
    if not isfile(folder / native(photo)):
        found = (suffix for suffix in SUFFIXES if isfile(folder / native(photo + suffix)))
        photo += next(found, "")
    parts = [part for part in PurePosixPath(photo).parts if part not in ("..", "/")]
    return "/".join(parts), folder / native(photo)


def _text(value, key):
    if not isinstance(value, str) or CONTROL.search(value):
        raise ValueError(f"{key} is no text")
    return value


def _check_lens(source, frame):
    bent = [key for key in DISTORTION if _number(frame, key, 0)]
    model = frame.get("camera_model", PINHOLES[0])
    if model not in PINHOLES or frame.get("is_fisheye"):
        bent = ["no pinhole camera", *bent]
    if bent:
        raise InputError(
            f"{source}: has lens distortion ({', '.join(bent)}) and clsplat wants none; "
            "undistort the photos with `colmap image_undistorter`, and use the folder it makes")


def _focal(frame, key, angle_key, side, default=None):
    """Focal length in pixels, as given, or by the angle of view, radians."""
    if key in frame:
        return _number(frame, key)
    if angle_key not in frame:
        if default is None:
            raise ValueError(f"it has neither {key} nor {angle_key}")
        return default
    angle = _number(frame, angle_key)
    if not 0 < angle < np.pi:
        raise ValueError(f"{angle_key} is no angle of view")
    return side / 2 / np.tan(angle / 2)


def _side(frame, key):
    value = _number(frame, key)
    if value != int(value) or not 0 < value < LONGEST_SIDE:
        raise ValueError(f"{key} is no number of pixels")
    return int(value)


def _number(frame, key, default=None):
    value = frame.get(key, default)
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        raise ValueError(f"{key} is no number" if key in frame else f"it has no {key}")
    return float(value)


def _cloud(path, table):
    """`read_cloud`, in the coordinates of the poses."""
    named = table.get("ply_file_path")
    try:
        ply = None if named is None else path.parent / native(_text(named, "ply_file_path"))
        # nerfstudio turns COLMAP's world so before it writes poses and PLY
        turn = _matrix(table, "applied_transform") if "applied_transform" in table else np.eye(3, 4)
        turn = turn * _number(table, "applied_scale", 1)
    except (ValueError, TypeError, OverflowError) as error:
        raise InputError(f"{path}: damaged ({reason(error)}); export it again") from None
    return read_cloud(path.parent, ply, turn)
