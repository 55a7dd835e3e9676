"""Reads transforms.json: instant-ngp's and nerfstudio's, and MatrixCity's (Li et al. 2023).

Poses are camera to world with camera axes right, up, back. MatrixCity has two kinds of file. Its
splits (transforms_train.json, transforms_test.json) are in units of 100 m. Its exports from Unreal
Engine have frames with `rot_mat`, rotations divided by 100 and positions in metres, and
`frame_index`, the photo's name; they are converted to the units of the splits, so that the point
clouds of these fit (authors' answer in city-super/MatrixCity, issue 9). Other keys, such as
aabb_scale, do not describe the cameras and are ignored.
"""

from collections.abc import Mapping
from os.path import isfile
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.io.checks import CONTROL
from clsplat.io.cloud import Cloud, read_cloud
from clsplat.io.images import image_size
from clsplat.io.lenses import PANORAMA, Model
from clsplat.io.posed import PosedPhoto, posed_scene
from clsplat.io.reason import reason
from clsplat.io.records import object_of
from clsplat.io.regular import native, read_regular
from clsplat.scene import Scene

ALL, TRAIN, TEST = "transforms.json", "transforms_train.json", "transforms_test.json"
SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".PNG")  # tried if file_path has none
# camera_model -> the keys of its parameters, in COLMAP's order, after focal length and centre
RADIAL = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
LENSES = {"OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"), **dict.fromkeys(
    ("OPENCV", "FULL_OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"), RADIAL)}
MATRIXCITY_UNIT = 100.0  # metres
LONGEST_SIDE = 1 << 20  # pixels


def has_transforms(folder: Path) -> bool:
    """Whether a folder has transforms.json or transforms_train.json, and not a COLMAP model, which
    is preferred because it has tracks."""
    model = ("sparse", "cameras.bin", "cameras.txt")
    return (any((folder / name).is_file() for name in (TRAIN, ALL))
            and not any((folder / name).exists() for name in model))


def read_transforms(folder: Path) -> Scene:
    """Read the scene of a folder with transforms_train.json and perhaps transforms_test.json, whose
    views are held out, or with transforms.json alone, and recentre it.

    Photos are at `file_path`, relative to the folder; the name of a view is that path without "..".
    The points are those of `ply_file_path` or of `cloud.read_cloud`; without them they are sampled.
    """
    path = folder / (TRAIN if (folder / TRAIN).exists() else ALL)
    table = _table(path)
    photos = _posed_photos(path, table, False)
    if path.name == TRAIN and (folder / TEST).exists():
        photos += _posed_photos(folder / TEST, _table(folder / TEST), True)
    return posed_scene(path, folder, photos, _cloud(path, table))


def _table(path: Path) -> dict[str, Any]:
    try:
        table = object_of(read_regular(path))
        if not isinstance(table.get("frames"), list) or not table["frames"]:
            raise ValueError("it has no frames")
        return table
    except (ValueError, OSError) as error:
        raise InputError(f"{path}: not a transforms.json, or damaged ({reason(error)}); "
                         "export or copy it again") from None


def _posed_photos(path: Path, table: Mapping[str, Any], held_out: bool) -> list[PosedPhoto]:
    photos = []
    for number, frame in enumerate(table["frames"]):
        try:
            photos.append(_posed_photo(path.parent, {**table, **frame}, held_out))
        except (ValueError, TypeError, OverflowError, OSError) as error:
            raise InputError(f"{path}: frame {number} is damaged ({reason(error)}); "
                             "export it again") from None
    return photos


def _posed_photo(folder: Path, frame: Mapping[str, Any], held_out: bool) -> PosedPhoto:
    """The photo of a frame, which includes the keys that the file gives for all frames."""
    pose, file_path = _pose(frame)
    name, source = _photo(folder, file_path)
    if "w" in frame and "h" in frame:
        size = _side(frame, "w"), _side(frame, "h")
    else:
        size = image_size(source)
    focal_x = _focal(frame, "fl_x", "camera_angle_x", size[0])
    focal_y = _focal(frame, "fl_y", "camera_angle_y", size[1], focal_x)
    centre = (_number(frame, "cx", size[0] / 2), _number(frame, "cy", size[1] / 2))
    mask = frame.get("mask_path")
    return PosedPhoto(name, source, size, (focal_x, focal_y), centre, pose, held_out,
                      _lens(frame, size, (focal_x, focal_y, *centre)),
                      None if mask is None else folder / native(_text(mask, "mask_path")))


def _pose(frame: Mapping[str, Any]) -> tuple[NDArray[np.float64], Any]:
    """The pose float64[3, 4], and the path of the photo, unchecked."""
    if "rot_mat" not in frame:
        return _matrix(frame, "transform_matrix"), frame.get("file_path")
    pose = _matrix(frame, "rot_mat")
    pose[:, :3] *= MATRIXCITY_UNIT
    pose[:, 3] /= MATRIXCITY_UNIT
    return pose, f"{_number(frame, 'frame_index'):04.0f}.png"


def _matrix(table: Mapping[str, Any], key: str) -> NDArray[np.float64]:
    matrix = np.array(table.get(key), np.float64)
    if matrix.shape not in ((3, 4), (4, 4)):
        raise ValueError(f"{key} is not a 3x4 or 4x4 matrix")
    return matrix[:3]


def _photo(folder: Path, file_path: object) -> tuple[str, Path]:
    """(name of the view, path) of a photo that may lack its suffix."""
    photo = _text(file_path, "file_path").replace("\\", "/")
    if not isfile(folder / native(photo)):
        photo += next((suffix for suffix in SUFFIXES if isfile(folder / native(photo + suffix))),
                      "")
    parts = [part for part in PurePosixPath(photo).parts if part not in ("..", "/")]
    return "/".join(parts), folder / native(photo)


def _text(value: object, key: str) -> str:
    if not isinstance(value, str) or CONTROL.search(value):
        raise ValueError(f"{key} is not valid text")
    return value


def _lens(frame: Mapping[str, Any], size: tuple[int, int], pinhole: tuple[float, ...]
          ) -> Model | None:
    """The camera model of a frame; None for a pinhole camera."""
    name = frame.get("camera_model") or "OPENCV"
    if frame.get("is_fisheye"):
        name = "OPENCV_FISHEYE"
    if name == PANORAMA:
        return PANORAMA, tuple(map(float, size))
    if name not in LENSES:
        raise ValueError(f"camera_model is {str(name)[:40]!r}, not {', '.join(LENSES)} "
                         f"or {PANORAMA}")
    values = tuple(_number(frame, key, 0) for key in LENSES[name])
    if name == "OPENCV_FISHEYE":
        return name, (*pinhole, *values)
    if not any(values):
        return None
    return ("FULL_OPENCV" if any(values[4:]) else "OPENCV",
            (*pinhole, *(values if any(values[4:]) else values[:4])))


def _focal(frame: Mapping[str, Any], key: str, angle_key: str, side: int,
           default: float | None = None) -> float:
    """Focal length in pixels, directly or from the angle of view in radians."""
    if key in frame:
        return _number(frame, key)
    if angle_key not in frame:
        if default is None:
            raise ValueError(f"it has neither {key} nor {angle_key}")
        return default
    angle = _number(frame, angle_key)
    if not 0 < angle < np.pi:
        raise ValueError(f"{angle_key} is not an angle of view")
    return float(side / 2 / np.tan(angle / 2))


def _side(frame: Mapping[str, Any], key: str) -> int:
    value = _number(frame, key)
    if value != int(value) or not 0 < value < LONGEST_SIDE:
        raise ValueError(f"{key} is not a number of pixels")
    return int(value)


def _number(frame: Mapping[str, Any], key: str, default: float | None = None) -> float:
    value = frame.get(key, default)
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        raise ValueError(f"{key} is not a number" if key in frame else f"it has no {key}")
    return float(value)


def _cloud(path: Path, table: Mapping[str, Any]) -> Cloud | None:
    """The points and colours of `read_cloud`, in the coordinates of the poses."""
    file_path = table.get("ply_file_path")
    try:
        ply = None if file_path is None else path.parent / native(_text(file_path, "ply_file_path"))
        # nerfstudio applies this to COLMAP's world before it writes poses and PLY
        transform = (_matrix(table, "applied_transform") if "applied_transform" in table
                     else np.eye(3, 4)) * _number(table, "applied_scale", 1)
    except (ValueError, TypeError, OverflowError) as error:
        raise InputError(f"{path}: damaged ({reason(error)}); export it again") from None
    return read_cloud(path.parent, ply, transform)
