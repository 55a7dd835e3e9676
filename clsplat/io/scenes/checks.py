"""What every scene must satisfy, whatever file it came from."""

from collections.abc import Iterator, Mapping, Sequence
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
AGAIN = "reconstruct the scene again"
USABLE = f"finite and below {LARGEST_COORDINATE:g}"


def checked_scene(path: Path, name: str, model: Mapping[str, NDArray[Any]], sources: Sequence[Path]) -> Scene:
    """Check plain arrays and build their scene, not recentred, with its views sorted by name.

    Parameters
    ----------
    path : the file that messages name.
    model : names [V]; rotations float64[V, 3, 3] and translations float64[V, 3], world to camera;
        focals and centres float64[V, 2] and sizes int[V, 2], pixels; lenses [V] (Lens or None);
        perhaps points float64[N, 3] with colours uint8[N, 3], and with observations int[M, 2], rows
        (point, view) in any order.
    sources : photos of the V views.
    """
    names = list(map(str, model["names"]))
    if not names:
        raise InputError(f"{path}: the model has no registered image; {AGAIN}")
    for image in names:
        fault = _fault_of_name(image)
        if fault:
            raise InputError(f"{path}: image name {image[:80]!r} {fault}; rename the photo, or {AGAIN}")
    if len(set(names)) != len(names):
        twice = next(image for image in names if names.count(image) > 1)
        raise InputError(f"{path}: image {twice} occurs twice in the model; {AGAIN}")
    for wrong, subject, fault in _faults_of_cameras(model):
        if wrong.any():
            raise InputError(
                f"{path}: the {subject} of image {names[np.argmax(wrong)]} {fault} "
                f"({wrong.sum()} of {len(names)} images); {AGAIN}"
            )
    cameras = (
        Camera(width, height, tuple(focal), tuple(centre), rotation, translation)
        for (width, height), focal, centre, rotation, translation in zip(
            model["sizes"].tolist(),
            model["focals"].tolist(),
            model["centres"].tolist(),
            np.array(model["rotations"], np.float64),
            np.array(model["translations"], np.float64),
        )
    )
    views = map(View, names, cameras, sources, model["lenses"])
    points = np.zeros((0, 3))
    if "points" in model:
        points = np.array(model["points"], np.float64)
        _check_points(path, points)
    return Scene(
        name,
        tuple(sorted(views, key=lambda view: view.name)),
        points,
        np.array(model.get("colours", points), np.uint8),
        path=path,
        observations=_sorted(model["observations"], names) if len(model.get("observations", ())) else None,
    )


def _fault_of_name(name: str) -> str:
    parts = PurePosixPath(name.replace("\\", "/"))
    if not parts.parts or parts.is_absolute() or ".." in parts.parts:
        return "leaves the scene's image folder"
    if CONTROL.search(name):
        return "is not valid text"
    longest = max(len(part.encode()) for part in parts.parts)
    return "is too long for a file system" if longest > LONGEST_NAME_BYTES else ""


def _faults_of_cameras(model: Mapping[str, NDArray[Any]]) -> Iterator[tuple[NDArray[np.bool_], str, str]]:
    """bool[V], the images that have a fault, of what, and the fault; each if no other was found."""
    for key, subject in (("rotations", "pose"), ("translations", "pose"), ("focals", "camera"), ("centres", "camera")):
        yield _unusable(model[key]), subject, f"is not {USABLE}"
    rotations = model["rotations"]
    error = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    wrong = np.logical_or(error > ROTATION_TOLERANCE, np.linalg.det(rotations) < 0)
    yield wrong, "pose", "is not a rotation"
    empty = np.any(np.hstack([model["focals"], model["sizes"]]) <= 0, axis=1)
    yield empty, "camera", "has no size or no focal length"


def _unusable(values: NDArray[Any]) -> NDArray[np.bool_]:
    rows = np.abs(values.reshape(len(values), -1))
    unusable: NDArray[np.bool_] = np.any(~(rows <= LARGEST_COORDINATE), axis=1)
    return unusable


def _check_points(path: Path, points: NDArray[np.float64]) -> None:
    if not len(points):
        raise InputError(f"{path}: the sparse model has no points; {AGAIN} with more overlap between the photos")
    wrong = _unusable(points)
    if wrong.any():
        raise InputError(f"{path}: {wrong.sum()} of {len(points)} points are not {USABLE}; remove them, or {AGAIN}")
    if (points == points[0]).all():
        raise InputError(
            f"{path}: the sparse model's {len(points)} points all lie at one place; "
            f"{AGAIN}, or check the units of its points"
        )


def _sorted(observations: NDArray[Any], names: list[str]) -> NDArray[np.int32]:
    """int32[M, 2], rows (point, view in the order of sorted names), sorted, each once."""
    point, view = np.asarray(observations, np.int64).T
    rows = np.sort(point * len(names) + np.argsort(np.argsort(names))[view])
    rows = rows[np.diff(rows, prepend=-1) > 0]  # np.unique takes far longer
    return np.stack(np.divmod(rows, len(names)), axis=1).astype(np.int32)
