"""What every scene must satisfy, whatever file it came from."""

import re
from pathlib import Path, PurePosixPath

import numpy as np

from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.scene import Scene, View

ROTATION_TOLERANCE = 1e-3
LARGEST = 1e15  # world units or pixels: squares and their sums stay far within float32
LONGEST_NAME = 255  # bytes of a part of an image's name: what file systems take
LONGEST_ENDING = 10  # bytes that pictures of a view add to its name: ".png", while written ".part"
CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]")  # what ends lines, and the like


def checked_scene(path, name, model, sources, offset=None):
    """Scene from plain arrays, or InputError naming `path`; the frame is left as it is.

    model: names [V]; rotations float64[V, 3, 3] and translations float64[V, 3], world to camera;
    focals and centres float64[V, 2] and sizes int[V, 2], pixels; points float64[N, 3]; colours
    uint8[N, 3]; observations int[M, 2], rows (point, view) in any order, may be missing. sources:
    V paths or encoded images; offset: of the scene, if its origin was moved before. Views come out
    sorted by name, and observations count them in that order.
    """
    model = {key: values.astype(np.float64) if values is not None and values.dtype.kind == "f"
             else values for key, values in model.items()}
    names = _checked_names(path, model["names"])
    if not names:
        raise InputError(f"{path}: the model has no registered image; reconstruct the scene again")
    _check_poses(path, names, model)
    _check_points(path, model["points"])
    origin = np.zeros(3) if offset is None else np.array(offset, np.float64)
    views = (View(n, Camera(*(int(v) for v in model["sizes"][i]),
                            tuple(float(v) for v in model["focals"][i]),
                            tuple(float(v) for v in model["centres"][i]),
                            np.array(model["rotations"][i], np.float64),
                            np.array(model["translations"][i], np.float64), offset=origin),
                  sources[i])
             for i, n in enumerate(names))
    seen = _checked_observations(path, names, len(model["points"]), model.get("observations"))
    return Scene(name, tuple(sorted(views, key=lambda view: view.name)),
                 np.array(model["points"], np.float64), np.array(model["colours"], np.uint8),
                 origin, Path(path), seen)


def _checked_names(path, names):
    try:
        names = [str(name).encode().decode() for name in names]
    except (SystemError, ValueError):  # numpy keeps code points that no character has
        raise InputError(f"{path}: an image name is no text; reconstruct the scene again") from None
    for name in names:
        parts = PurePosixPath(name.replace("\\", "/"))
        if not parts.parts or parts.is_absolute() or ".." in parts.parts:
            raise InputError(f"{path}: image name {name[:80]!r} leaves the scene's image folder; "
                             "names must be relative to it")
        if CONTROL.search(name):
            raise InputError(f"{path}: image name {name[:80]!r} is no text; "
                             "rename the photo, or reconstruct the scene again")
        longest = max(len(part.encode()) for part in parts.parts)
        if max(longest, len(parts.name.encode()) + LONGEST_ENDING) > LONGEST_NAME:
            raise InputError(f"{path}: image name {name[:80]!r}... is too long: its pictures are "
                             f"named after it, and a file system takes {LONGEST_NAME} bytes; "
                             "rename the photo, or reconstruct the scene again")
    if len(set(names)) != len(names):
        twice = next(n for n in names if names.count(n) > 1)
        raise InputError(f"{path}: image {twice} occurs twice in the model; "
                         "reconstruct the scene again")
    return names


def _check_poses(path, names, model):
    for key, what in (("rotations", "pose"), ("translations", "pose"), ("focals", "camera"),
                      ("centres", "camera")):
        for right, wish in ((np.isfinite(model[key]), "finite"),
                            (np.abs(model[key]) <= LARGEST, f"below {LARGEST:g}")):
            right = right.reshape(len(names), -1).all(axis=1)
            if not right.all():
                raise InputError(f"{path}: the {what} of image {names[np.argmin(right)]} is not "
                                 f"{wish} ({np.sum(~right)} of {len(names)} images); "
                                 "reconstruct the scene again")
    rotations = model["rotations"]
    error = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    wrong = (error > ROTATION_TOLERANCE) | (np.linalg.det(rotations) < 0)
    if wrong.any():
        raise InputError(f"{path}: the pose of image {names[np.argmax(wrong)]} is no rotation "
                         f"({wrong.sum()} of {len(names)} images); reconstruct the scene again")
    wrong = (model["focals"] <= 0).any(axis=1) | (model["sizes"] <= 0).any(axis=1)
    if wrong.any():
        raise InputError(f"{path}: the camera of image {names[np.argmax(wrong)]} has no size or "
                         "no focal length; reconstruct the scene again")


def _check_points(path, points):
    if not len(points):
        raise InputError(f"{path}: the sparse model has no points; reconstruct the scene again "
                         "with more overlap between the photos")
    for right, wish in ((np.isfinite(points), "finite"),
                        (np.abs(points) <= LARGEST, f"below {LARGEST:g}")):
        right = right.all(axis=1)
        if not right.all():
            raise InputError(f"{path}: {np.sum(~right)} of {len(points)} points are not {wish}; "
                             "remove them, or reconstruct the scene again")
    if (points == points[0]).all():
        raise InputError(f"{path}: the sparse model's {len(points)} points all lie at one place; "
                         "reconstruct the scene again, or check the units of its points")


def _checked_observations(path, names, points, observations):
    """int32[M, 2], rows (point, view in the order of sorted names), sorted, each once; or None."""
    if observations is None or not len(observations):
        return None
    observations = np.asarray(observations, np.int64)
    wrong = ((observations < 0) | (observations >= (points, len(names)))).any(axis=1)
    if wrong.any():
        raise InputError(f"{path}: {wrong.sum()} of {len(wrong)} observations name a point or an "
                         "image that the model does not have; pack or reconstruct the scene again")
    place = np.argsort(np.argsort(names))
    rows = np.unique(observations[:, 0] * len(names) + place[observations[:, 1]])
    return np.stack(np.divmod(rows, len(names)), axis=1).astype(np.int32)
