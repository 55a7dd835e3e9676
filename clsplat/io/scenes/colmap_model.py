"""Reads the arrays of a COLMAP sparse model, and checks that its files are whole and fit."""

from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.io.photos.lenses import undistorted_model
from clsplat.io.scenes.colmap_binary import read_binary
from clsplat.io.scenes.colmap_format import PARTS, PINHOLES, Camera, Image, Points, places_within
from clsplat.io.scenes.colmap_text import read_text

LONGEST_SIDE = 2**31  # pixels; what is larger is damaged, and overflows


def model_arrays(model: Path, may_be_empty: Collection[str] = ()) -> dict[str, NDArray[Any]]:
    """Read the arrays of `lenses.undistorted_model`, with images sorted by name and points by id.

    Parameters
    ----------
    model : the folder of a COLMAP model.
    may_be_empty : parts that may be empty, such as points3D of test views.
    """
    cameras, images, points = model_parts(model, may_be_empty)
    images = sorted(images, key=lambda image: image.name)
    for image in images:
        if image.camera not in cameras:
            raise InputError(f"{model}: image {image.name[:80]} has camera {image.camera}, which "
                             "is not in the model; copy the whole model again")
    used = [cameras[image.camera] for image in images]
    ids = np.array([image.number for image in images], np.int64)
    _check_ids(model, "images", ids)
    _check_ids(model, "points3D", points.ids)
    order = np.argsort(points.ids)
    arrays = {
        "names": np.array([image.name for image in images], dtype=np.str_),
        "rotations": _rotations(np.array([image.quaternion for image in images]).reshape(-1, 4)),
        "translations": np.array([image.translation for image in images]).reshape(-1, 3),
        "focals": _pairs(_focal(camera) for camera in used),
        "centres": _pairs(_centre(camera) for camera in used),
        "sizes": np.array([(min(camera.width, LONGEST_SIDE), min(camera.height, LONGEST_SIDE))
                           for camera in used], np.int64).reshape(-1, 2),
        "points": points.positions[order],
        "colours": points.colours[order],
        "observations": _observations(ids, points, order),
    }
    return undistorted_model(model, arrays, [
        None if camera.model in PINHOLES else (camera.model, camera.parameters)
        for camera in used])


def model_parts(model: Path, may_be_empty: Collection[str] = ()
                ) -> tuple[dict[int, Camera], list[Image], Points]:
    """Read the cameras by id, the images and the points of a COLMAP model."""
    kind = "bin" if any((model / f"{part}.bin").exists() for part in PARTS) else "txt"
    cameras, images, points = (
        _read_part(model / f"{part}.{kind}", part, part in may_be_empty) for part in PARTS)
    return cameras, images, points


def _read_part(path: Path, part: str, may_be_empty: bool) -> Any:
    if not path.exists():
        raise InputError(f"{path}: missing from the COLMAP model; copy the whole model")
    try:
        content = (read_binary if path.suffix == ".bin" else read_text)(path, part)
    except ValueError as error:
        raise InputError(f"{path}: {error}; copy the model again") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check its permissions"
                         ) from None
    if not (len(content.ids if part == "points3D" else content) or may_be_empty):
        raise InputError(f"{path}: holds no {part}; reconstruct the scene again")
    return content


def _check_ids(model: Path, part: str, ids: NDArray[np.int64]) -> None:
    values, counts = np.unique(ids, return_counts=True)
    if len(values) < len(ids):
        raise InputError(f"{model}: {part} holds id {values[np.argmax(counts)]} twice; "
                         "copy the model again, or reconstruct the scene")


def _pairs(values: Iterable[tuple[float, ...]]) -> NDArray[np.float64]:
    return np.array(list(values), np.float64).reshape(-1, 2)


def _focal(camera: Camera) -> tuple[float, ...]:
    """(x, y) in pixels; 0 for models with distortion, whose photos get another camera."""
    return {"PINHOLE": camera.parameters[:2],
            "SIMPLE_PINHOLE": camera.parameters[:1] * 2}.get(camera.model, (0, 0))


def _centre(camera: Camera) -> tuple[float, ...]:
    return camera.parameters[-2:] if camera.model in PINHOLES else (0, 0)


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
        return np.stack([
            1 - (ty * y + tz * z), ty * x - tz * w, tz * x + ty * w,
            ty * x + tz * w, 1 - (tx * x + tz * z), tz * y - tx * w,
            tz * x - ty * w, tz * y + tx * w, 1 - (tx * x + ty * y)], axis=1).reshape(-1, 3, 3)


def _observations(ids: NDArray[np.int64], points: Points, order: NDArray[np.int64]
                  ) -> NDArray[np.int32]:
    """int32[M, 2], indices (point, image) of the observations in images that the model has."""
    begins = np.cumsum(points.lengths) - points.lengths
    lengths = points.lengths[order]
    rows = np.repeat(np.arange(len(order)), lengths)
    images = points.images[np.repeat(begins[order], lengths) + places_within(lengths)]
    by_id = np.argsort(ids)
    if not len(ids):
        return np.zeros((0, 2), np.int32)
    place = by_id[np.minimum(np.searchsorted(ids[by_id], images), len(ids) - 1)]
    known = ids[place] == images
    return np.stack([rows[known], place[known]], axis=1).astype(np.int32)
