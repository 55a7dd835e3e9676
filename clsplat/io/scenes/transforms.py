"""Reads transforms.json: instant-ngp's and nerfstudio's, and MatrixCity's (Li et al. 2023).

Poses are camera to world with camera axes right, up, back. Keys that do not describe the cameras,
such as aabb_scale, are ignored.
"""

import re
from collections.abc import Mapping
from os.path import isfile
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import reason
from clsplat.io.fields import number, pixels, reading, text
from clsplat.io.photos.images import image_size
from clsplat.io.photos.lenses import PANORAMA
from clsplat.io.records import object_of
from clsplat.io.regular import read_regular
from clsplat.io.scenes import posed
from clsplat.scene import Scene

ALL, TRAIN, TEST = "transforms.json", "transforms_train.json", "transforms_test.json"
SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".PNG")  # tried if file_path has none
# of FULL_OPENCV; elsewhere k4 is the factor of r^8
DIVIDES = {"k4": "d1", "k5": "d2", "k6": "d3"}
LEADS_AWAY = re.compile(r"\.\.|//?|[A-Za-z]:")  # such parts of a path
MODEL = ("camera_model", "is_fisheye")
FOCAL_X, FOCAL_Y = ("fl_x", "camera_angle_x"), ("fl_y", "camera_angle_y")
# camera_model -> models of COLMAP
MODELS = {
    posed.FISHEYE[0]: posed.FISHEYE,
    **dict.fromkeys(("OPENCV", "FULL_OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"), posed.BROWN),
}


def find_transforms(path: Path) -> Path | None:
    """transforms_train.json or transforms.json in a folder without a COLMAP model, which is
    preferred because it has tracks."""
    if any((path / name).exists() for name in ("sparse", "cameras.bin", "cameras.txt")):
        return None
    return next((path / name for name in (TRAIN, ALL) if (path / name).is_file()), None)


def read_transforms(path: Path, images: str = "") -> Scene:
    """Read the scene of transforms.json, or of transforms_train.json and perhaps the
    transforms_test.json beside it, whose views are held out, and recentre it.

    The name of a view is the `file_path` of its photo, relative to the folder, without "..". The
    points are those of `ply_file_path` or of `posed.read_cloud`; without them they are sampled.
    """
    test = path.with_name(TEST)
    with reading(path, "a transforms.json"):
        table, photos = _posed_photos(path, False)
        cloud = _cloud(path.parent, table)
    if path.name == TRAIN and test.exists():
        with reading(test, "a transforms.json"):
            photos += _posed_photos(test, True)[1]
    return posed.posed_scene(path, path.parent, photos, cloud)


def _posed_photos(path: Path, held_out: bool) -> tuple[dict[str, Any], list[posed.PosedPhoto]]:
    """The table of a file, and the photos of its frames."""
    table, photos = object_of(read_regular(path)), []
    if not isinstance(table.get("frames"), list) or not table["frames"]:
        raise ValueError("it has no frames")
    for index, frame in enumerate(table["frames"]):
        try:
            photos.append(_posed_photo(path.parent, _own(table, frame), held_out))
        except (ValueError, TypeError, OverflowError, OSError) as error:
            raise ValueError(f"frame {index}: {reason(error)}") from None
    return table, photos


def _own(table: Mapping[str, Any], frame: Mapping[str, Any]) -> dict[str, Any]:
    """The values of a frame, and those of the table that these leave open.

    A focal length and an angle of view mean the same, as do the two ways to name a fisheye: if
    the frame has one, the table's other one does not count. The table's y belongs to its x, and its
    coefficients to its camera model.
    """
    if not isinstance(frame, Mapping):
        raise ValueError("it is not an object")
    own, replaced = frame.keys(), set[str]()
    if own & {*FOCAL_X}:
        replaced |= {*FOCAL_X}
    if own & {*FOCAL_Y} or own & {*FOCAL_X} and table.keys() & {*FOCAL_X}:
        replaced |= {*FOCAL_Y}
    if own & {*MODEL}:
        replaced |= {*MODEL, *posed.COEFFICIENTS}
    return {**{key: value for key, value in table.items() if key not in replaced}, **frame}


def _posed_photo(folder: Path, frame: Mapping[str, Any], held_out: bool) -> posed.PosedPhoto:
    """The photo of a frame, which includes the keys that the file gives for all frames."""
    pose = _matrix(frame, "transform_matrix")
    name, source = _photo(folder, frame.get("file_path"))
    if "w" in frame and "h" in frame:
        size = pixels(frame["w"], "w"), pixels(frame["h"], "h")
    else:
        size = image_size(source)
    focal_x = _focal(frame, *FOCAL_X, size[0])
    focal_y = _focal(frame, *FOCAL_Y, size[1], focal_x)
    centre = (_number(frame, "cx", size[0] / 2), _number(frame, "cy", size[1] / 2))
    mask = frame.get("mask_path")
    return posed.PosedPhoto(
        name,
        source,
        _optics(frame, size, (focal_x, focal_y), centre),
        (pose[:, :3] * posed.FLIPPED).T,
        pose[:, 3],
        held_out,
        None if mask is None else folder / text(mask, "mask_path"),
    )


def _matrix(table: Mapping[str, Any], key: str) -> NDArray[np.float64]:
    matrix = np.array(table.get(key), np.float64)
    if matrix.shape not in ((3, 4), (4, 4)):
        raise ValueError(f"{key} is not a 3x4 or 4x4 matrix")
    if len(matrix) == 4 and not np.allclose(matrix[3], (0, 0, 0, 1)):
        raise ValueError(f"the last row of {key} is not 0 0 0 1; is it transposed?")
    return matrix[:3]


def _photo(folder: Path, file_path: object) -> tuple[str, Path]:
    """(name of the view, path) of a photo that may lack its suffix."""
    photo = text(file_path, "file_path").replace("\\", "/")
    if not isfile(folder / photo):
        photo += next((suffix for suffix in SUFFIXES if isfile(folder / (photo + suffix))), "")
    # pictures are written under the name, so it must not leave their folder: neither up, nor to the
    # root, nor to another drive of Windows
    parts = [part for part in PurePosixPath(photo).parts if not LEADS_AWAY.fullmatch(part)]
    return "/".join(parts), folder / photo


def _optics(
    frame: Mapping[str, Any], size: tuple[int, int], focal: tuple[float, float], centre: tuple[float, float]
) -> posed.Optics:
    if "ftheta_p0" in frame:
        raise ValueError("the lens F-theta is not read; export with OPENCV_FISHEYE")
    name = posed.FISHEYE[0] if frame.get("is_fisheye") else frame.get("camera_model") or "OPENCV"
    if name == PANORAMA:
        return posed.Optics(size, focal, centre, (PANORAMA, tuple(map(float, size))))
    if not isinstance(name, str) or name not in MODELS:
        raise ValueError(f"camera_model is {str(name)[:40]!r}, not {', '.join(MODELS)} or {PANORAMA}")
    divides = DIVIDES if name == "FULL_OPENCV" else {}
    return posed.optics(
        size, focal, centre, MODELS[name], {divides.get(key, key): _number(frame, key, 0) for key in posed.COEFFICIENTS}
    )


def _focal(frame: Mapping[str, Any], key: str, angle_key: str, side: int, default: float | None = None) -> float:
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


def _number(frame: Mapping[str, Any], key: str, default: float | None = None) -> float:
    if key not in frame and default is None:
        raise ValueError(f"it has no {key}")
    return number(frame.get(key, default), key)


def _cloud(folder: Path, table: Mapping[str, Any]) -> posed.Cloud | None:
    """The points and colours of `read_cloud`, in the coordinates of the poses."""
    file_path = table.get("ply_file_path")
    ply = None if file_path is None else folder / text(file_path, "ply_file_path")
    # nerfstudio applies this to COLMAP's world before it writes poses and PLY
    transform = (_matrix(table, "applied_transform") if "applied_transform" in table else np.eye(3, 4)) * _number(
        table, "applied_scale", 1
    )
    return posed.read_cloud(folder, ply, transform)
