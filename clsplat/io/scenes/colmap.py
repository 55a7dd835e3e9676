"""Reads a COLMAP reconstruction as a scene; checks that its model is whole and fits."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.io.fields import reading
from clsplat.io.photos.lenses import undistorted_model
from clsplat.io.scenes.checks import checked_scene
from clsplat.io.scenes.colmap_files import PARTS, PINHOLES, read_part
from clsplat.io.scenes.sources import IMAGES, checked_photos, photo_folder
from clsplat.scene import Scene

if TYPE_CHECKING:
    import pycolmap

# of CityGS's data sets (Liu et al. 2024): COLMAP folders in one world frame, and those of photos
TRAIN, VAL = "train", "val"
PHOTOS = (IMAGES, "rgbs")
PER_VIEW = ("names", "rotations", "translations", "focals", "centres", "sizes", "lenses")
LONGEST_SIDE = 2**31  # pixels; what is larger is damaged, and overflows


def find_colmap(path: Path) -> Path | None:
    """The path if it is a folder that is meant to have a sparse model; a transforms.json is
    preferred to files without cameras."""
    if _is_model(path, PARTS[:1]) or (path / "sparse").exists():
        return path
    return path if _is_model(path) and not any(path.glob("transforms*.json")) else None


def read_colmap(folder: Path, images: str = "") -> Scene:
    """Read and recentre the scene of a folder with `images/` and a COLMAP model, binary or text.

    The model is searched in sparse/0, sparse, the folder itself and other sparse/N. Every photo
    must exist in its camera's size or, in another folder than images/, be smaller by one factor for
    all. Only their headers are read.

    Parameters
    ----------
    images : the folder of the photos, see `photo_folder`.
    """
    model, arrays = read_model(folder)
    photos = photo_folder(folder, images)
    scene = checked_scene(model, folder.resolve().name, arrays, [photos / name for name in arrays["files"]])
    largest = max(_numbered_models(folder), key=_bytes, default=model)
    if model.parent.name == "sparse" and _bytes(largest) > _bytes(model):
        scene = replace(
            scene,
            notes=(
                f"the model sparse/{model.name} is used, and sparse/{largest.name} is larger: COLMAP "
                "has split the scene; to train the larger part, move it to sparse/0 of a folder of its "
                "own",
            ),
        )
    may_be_smaller = bool(images) or photos.name != IMAGES
    return checked_photos(scene, photos if may_be_smaller else None).recentred()


def find_citygs(path: Path) -> Path | None:
    """The path if it is a folder whose COLMAP models are in train/ and val/."""
    has_parts = (path / TRAIN / "sparse").is_dir() and not (path / "sparse").is_dir()
    return path if has_parts else None


def read_citygs(folder: Path, images: str = "") -> Scene:
    """Read the scene of a folder whose train/ and val/ are COLMAP folders, and recentre it.

    The views of val/ are held out, and the points are those of train/. Photos are in images/ or
    rgbs/ of each part; the name of a view begins with its part.
    """
    if not (folder / VAL).is_dir():
        raise InputError(
            f"{folder / VAL}: missing beside {TRAIN}/; to train without held-out "
            f"photos of their own give {folder / TRAIN}"
        )
    (_, train), (_, val) = read_model(folder / TRAIN), read_model(folder / VAL, ("points3D",))
    sources = []
    for part, arrays in ((folder / TRAIN, train), (folder / VAL, val)):
        photos = next((part / name for name in PHOTOS if (part / name).is_dir()), part / IMAGES)
        # joined as text, so that a name with a leading slash stays below the folder
        sources += [Path(f"{photos}/{name}") for name in arrays["files"]]
        arrays["names"] = np.array([f"{part.name}/{name}" for name in arrays["names"]])
    both = {key: np.concatenate([train[key], val[key]]) for key in PER_VIEW}
    scene = checked_photos(checked_scene(folder, folder.resolve().name, train | both, sources))
    return replace(scene, held_out=frozenset(map(str, val["names"]))).recentred()


def read_model(folder: Path, may_be_empty: Collection[str] = ()) -> tuple[Path, dict[str, NDArray[Any]]]:
    """The folder of a scene folder's model, and the arrays of `lenses.undistorted_model`, with
    images sorted by name and points by id, wherever the photos are.

    Parameters
    ----------
    may_be_empty : parts that may be empty, such as points3D of test views.
    """
    model = _find_model(folder)
    listed, images, points = (_part_of(model, part, part in may_be_empty) for part in PARTS)
    images = sorted(images, key=lambda image: image.name)
    ids = np.array([image.number for image in images], np.int64)
    for part, numbers in (
        ("cameras", np.array([camera.number for camera in listed])),
        ("images", ids),
        ("points3D", points.ids),
    ):
        values, counts = np.unique(numbers, return_counts=True)
        if len(values) < len(numbers):
            raise InputError(
                f"{model}: {part} holds id {values[np.argmax(counts)]} twice; "
                "copy the model again, or reconstruct the scene"
            )
    cameras = {camera.number: camera for camera in listed}
    for image in images:
        if image.camera not in cameras:
            raise InputError(
                f"{model}: image {image.name[:80]} has camera {image.camera}, which "
                "is not in the model; copy the whole model again"
            )
    used = [cameras[image.camera] for image in images]
    order, by_id = np.argsort(points.ids), np.argsort(ids)
    image_of = by_id[np.searchsorted(ids[by_id], points.images).clip(max=len(ids) - 1)]
    seen = np.stack([np.argsort(order)[points.rows], image_of], axis=1)
    # fx, fy, cx, cy; 0 for models with distortion, whose photos get another camera
    pinholes = np.array(
        [(camera.parameters[0], *camera.parameters[-3:]) if camera.model in PINHOLES else 4 * (0,) for camera in used],
        np.float64,
    )
    arrays = {
        "names": np.array([image.name for image in images], dtype=np.str_),
        "rotations": _rotations(np.array([image.quaternion for image in images])),
        "translations": np.array([image.translation for image in images]),
        "focals": pinholes[:, :2],
        "centres": pinholes[:, 2:],
        "sizes": np.array(
            [(min(camera.width, LONGEST_SIDE), min(camera.height, LONGEST_SIDE)) for camera in used], np.int64
        ),
        "points": points.positions[order],
        "colours": points.colours[order],
        "observations": seen[ids[image_of] == points.images],  # other images are not in the model
    }
    return model, undistorted_model(
        model, arrays, [None if camera.model in PINHOLES else (camera.model, camera.parameters) for camera in used]
    )


def _find_model(folder: Path) -> Path:
    """Find the sparse model of a scene folder: sparse/0, sparse, the folder itself, or else the
    model with the most images below sparse/."""
    for model in (folder / "sparse" / "0", folder / "sparse", folder):
        if _is_model(model):
            return model
    others = _numbered_models(folder)
    if others:
        return max(others, key=_bytes)
    raise InputError(
        f"{folder}: no COLMAP model in sparse/0, sparse or the folder itself; make a "
        "scene with `clsplat sfm` (docs/guide/photos.md), or give another folder"
    )


def _is_model(folder: Path, parts: Collection[str] = PARTS) -> bool:
    return any((folder / f"{part}.{kind}").exists() for part in parts for kind in ("bin", "txt"))


def _numbered_models(folder: Path) -> list[Path]:
    """The models sparse/N of a scene folder, by number."""
    return sorted(
        (path for path in (folder / "sparse").glob("*") if path.name.isdecimal() and _is_model(path)),
        key=lambda path: int(path.name),
    )


def _bytes(model: Path) -> int:
    """The size of a model's file of images, by which the largest of several is found."""
    return max((path.stat().st_size for path in model.glob("images.*")), default=0)


def _part_of(model: Path, part: str, may_be_empty: bool) -> Any:
    """One of the lists of `read_part` of a model, which is binary if any of its files is."""
    kind = "bin" if any((model / f"{each}.bin").exists() for each in PARTS) else "txt"
    path = model / f"{part}.{kind}"
    with reading(path, f"the {part} of a COLMAP model", "copy the model again"):
        content = read_part(path, part)
    if not (may_be_empty or len(content.ids if part == "points3D" else content)):
        raise InputError(f"{path}: holds no {part}; reconstruct the scene again")
    return content


def _rotations(quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    """float64[V, 3, 3] of quaternions (wxyz); not finite for a zero or non-finite quaternion.

    Quaternions of unit length up to rounding are not normalised, and products are summed in Eigen's
    order, so that the last digit equals COLMAP's.
    """
    with np.errstate(all="ignore"):
        length = np.linalg.norm(quaternions, axis=1, keepdims=True)
        unit = np.where(np.abs(length - 1) < 1e-12, quaternions, quaternions / length)
        w, x, y, z = unit.T
        tx, ty, tz = 2 * x, 2 * y, 2 * z
        return np.stack(
            [
                1 - (ty * y + tz * z),
                ty * x - tz * w,
                tz * x + ty * w,
                ty * x + tz * w,
                1 - (tx * x + tz * z),
                tz * y - tx * w,
                tz * x - ty * w,
                tz * y + tx * w,
                1 - (tx * x + ty * y),
            ],
            axis=1,
        ).reshape(-1, 3, 3)


def read_reconstruction(model: Path) -> pycolmap.Reconstruction:
    """Read a model that `read_model` has passed, with whole names: pycolmap cuts those in a text
    at their first blank."""
    import pycolmap

    try:
        reconstruction = pycolmap.Reconstruction(model)
    except IndexError:
        raise InputError(
            f"{model}: its images lack the observations of its points; write the "
            "scene anew with `clsplat pack`, and give that"
        ) from None
    for image in _part_of(model, "images", False):
        reconstruction.images[image.number].name = image.name
    return reconstruction


def write_reconstruction(folder: Path, reconstruction: pycolmap.Reconstruction) -> None:
    """Write a reconstruction into an existing folder, and read it back, since pycolmap
    does not notice a full disk; InputError if it is not whole."""
    reconstruction.write(folder)
    for part in PARTS:
        path = folder / f"{part}.bin"
        with reading(path, "written whole", "free some space and try again"):
            read_part(path, part)
