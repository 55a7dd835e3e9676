"""What every scene must satisfy, whatever file it came from."""

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.io.fields import CONTROL, LARGEST_COORDINATE
from clsplat.scene import Scene, View

ROTATION_TOLERANCE = 1e-3
# of a part of an image's name: file systems allow 255, of which pictures of a view need 10
LONGEST_NAME_BYTES = 245


def checked_scene(path: str | Path, name: str, model: Mapping[str, NDArray[Any]],
                  sources: Sequence[Path]) -> Scene:
    """Check plain arrays and build their scene, not recentred, with its views sorted by name.

    Parameters
    ----------
    path : the file that messages name.
    model : names [V]; rotations float64[V, 3, 3] and translations float64[V, 3], world to camera;
        focals and centres float64[V, 2] and sizes int[V, 2], pixels; points float64[N, 3] and
        colours uint8[N, 3]; perhaps observations int[M, 2], rows (point, view) in any order, and
        lenses [V] (Lens or None).
    sources : photos of the V views.
    """
    model = {key: values.astype(np.float64) if values.dtype.kind == "f" else values
             for key, values in model.items()}
    names = _checked_names(path, model["names"])
    if not names:
        raise InputError(f"{path}: the model has no registered image; reconstruct the scene again")
    _check_poses(path, names, model)
    _check_points(path, model["points"])
    cameras = (Camera(width, height, tuple(focal), tuple(centre), rotation, translation)
               for (width, height), focal, centre, rotation, translation in zip(
                   model["sizes"].tolist(), model["focals"].tolist(), model["centres"].tolist(),
                   np.array(model["rotations"], np.float64),
                   np.array(model["translations"], np.float64)))
    views = map(View, names, cameras, sources, model.get("lenses", len(names) * [None]))
    observations = _checked_observations(path, names, len(model["points"]),
                                         model.get("observations"))
    return Scene(name, tuple(sorted(views, key=lambda view: view.name)),
                 np.array(model["points"], np.float64), np.array(model["colours"], np.uint8),
                 path=Path(path), observations=observations)


def _checked_names(path: str | Path, names: NDArray[Any]) -> list[str]:
    names_text = list(map(str, names))
    for name in names_text:
        parts = PurePosixPath(name.replace("\\", "/"))
        if not parts.parts or parts.is_absolute() or ".." in parts.parts:
            raise InputError(f"{path}: image name {name[:80]!r} leaves the scene's image folder; "
                             "names must be relative to it")
        if CONTROL.search(name):
            raise InputError(f"{path}: image name {name[:80]!r} is not valid text; "
                             "rename the photo, or reconstruct the scene again")
        if max(len(part.encode()) for part in parts.parts) > LONGEST_NAME_BYTES:
            raise InputError(f"{path}: image name {name[:80]!r}... is too long: a file system "
                             f"allows {LONGEST_NAME_BYTES} bytes, besides a suffix; rename the "
                             "photo, or reconstruct the scene again")
    if len(set(names_text)) != len(names_text):
        twice = next(n for n in names_text if names_text.count(n) > 1)
        raise InputError(f"{path}: image {twice} occurs twice in the model; "
                         "reconstruct the scene again")
    return names_text


def _broken(values: NDArray[Any]) -> tuple[NDArray[np.bool_], str]:
    """Which rows are not finite or not below the largest coordinate, and which of both."""
    rows = np.abs(values.reshape(len(values), -1))
    infinite = ~np.isfinite(rows).all(axis=1)
    if infinite.any():
        return infinite, "finite"
    return (rows > LARGEST_COORDINATE).any(axis=1), f"below {LARGEST_COORDINATE:g}"


def _check_poses(path: str | Path, names: list[str], model: Mapping[str, NDArray[Any]]) -> None:
    for key, subject in (("rotations", "pose"), ("translations", "pose"), ("focals", "camera"),
                         ("centres", "camera")):
        wrong, limit = _broken(model[key])
        if wrong.any():
            raise InputError(f"{path}: the {subject} of image {names[np.argmax(wrong)]} is not "
                             f"{limit} ({wrong.sum()} of {len(names)} images); reconstruct the "
                             "scene again")
    rotations = model["rotations"]
    error = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    wrong = np.logical_or(error > ROTATION_TOLERANCE, np.linalg.det(rotations) < 0)
    if wrong.any():
        raise InputError(f"{path}: the pose of image {names[np.argmax(wrong)]} is not a rotation "
                         f"({wrong.sum()} of {len(names)} images); reconstruct the scene again")
    empty = (np.hstack([model["focals"], model["sizes"]]) <= 0).any(axis=1)
    if empty.any():
        raise InputError(f"{path}: the camera of image {names[np.argmax(empty)]} has no size or "
                         "no focal length; reconstruct the scene again")


def _check_points(path: str | Path, points: NDArray[Any]) -> None:
    if not len(points):
        raise InputError(f"{path}: the sparse model has no points; reconstruct the scene again "
                         "with more overlap between the photos")
    wrong, limit = _broken(points)
    if wrong.any():
        raise InputError(f"{path}: {wrong.sum()} of {len(points)} points are not {limit}; remove "
                         "them, or reconstruct the scene again")
    if (points == points[0]).all():
        raise InputError(f"{path}: the sparse model's {len(points)} points all lie at one place; "
                         "reconstruct the scene again, or check the units of its points")


def _checked_observations(path: str | Path, names: list[str], points: int,
                          observations: NDArray[Any] | None) -> NDArray[np.int32] | None:
    """int32[M, 2], rows (point, view in the order of sorted names), sorted, each once; or None."""
    if observations is None or not len(observations):
        return None
    observations = np.asarray(observations, np.int64)
    wrong = np.any((observations < 0) | (observations >= (points, len(names))), axis=1)
    if wrong.any():
        raise InputError(f"{path}: {wrong.sum()} of {len(wrong)} observations name a point or an "
                         "image that the model does not have; pack or reconstruct the scene again")
    place = np.argsort(np.argsort(names))
    rows = np.unique(observations[:, 0] * len(names) + place[observations[:, 1]])
    return np.stack(np.divmod(rows, len(names)), axis=1).astype(np.int32)
