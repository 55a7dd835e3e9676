"""Writes sparse models in COLMAP's classic binary format (cameras, images, points3D)."""

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.io.atomic import replacing
from clsplat.io.reason import reason
from clsplat.io.scenes.colmap_binary import read_binary
from clsplat.io.scenes.colmap_format import PARTS
from clsplat.scene import View

PINHOLE = 1  # COLMAP's number of the camera model with parameters fx, fy, cx, cy


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
    camera_ids: dict[tuple[float, ...], int] = {}
    for view in views:
        camera_ids.setdefault(_intrinsics(view.camera), len(camera_ids) + 1)
    by_view = [np.flatnonzero(tracks.views == i) for i in range(len(views))]
    for name, chunks in (("cameras", _cameras(camera_ids)),
                         ("images", _images(views, camera_ids, tracks, by_view)),
                         ("points3D", _points(views, points, colours, tracks, by_view))):
        with replacing(folder / f"{name}.bin") as file:
            file.writelines(chunks)


def write_reconstruction(folder: Path, reconstruction: Any) -> None:
    """Write a pycolmap.Reconstruction into an existing folder, and read it back, since pycolmap
    does not notice a full disk; InputError if it is not whole."""
    reconstruction.write(folder)
    for part in PARTS:
        try:
            read_binary(folder / f"{part}.bin", part)
        except (OSError, ValueError) as error:
            raise InputError(f"{folder / part}.bin: cannot be written whole ({reason(error)}); "
                             "free some space and try again") from None


def _intrinsics(camera: Camera) -> tuple[float, ...]:
    return camera.width, camera.height, *camera.focal, *camera.centre


def _cameras(camera_ids: Mapping[tuple[float, ...], int]) -> Iterator[bytes]:
    yield struct.pack("<Q", len(camera_ids))
    for (width, height, *parameters), number in camera_ids.items():
        yield struct.pack("<IiQQ4d", number, PINHOLE, width, height, *parameters)


def _images(views: Sequence[View], camera_ids: Mapping[tuple[float, ...], int], tracks: Tracks,
            by_view: Sequence[NDArray[Any]]) -> Iterator[bytes]:
    yield struct.pack("<Q", len(views))
    for number, (view, rows) in enumerate(zip(views, by_view), 1):
        x, y, z, w = Rotation.from_matrix(view.camera.rotation).as_quat()
        yield struct.pack("<I7dI", number, w, x, y, z, *view.camera.translation,
                          camera_ids[_intrinsics(view.camera)])
        yield view.name.encode() + b"\0"
        seen = np.empty(len(rows), [("pixel", "<f8", 2), ("point", "<u8")])
        seen["pixel"], seen["point"] = tracks.pixels[rows], tracks.points[rows] + 1
        yield struct.pack("<Q", len(rows)) + seen.tobytes()


def _points(views: Sequence[View], points: NDArray[np.float64], colours: NDArray[np.uint8],
            tracks: Tracks, by_view: Sequence[NDArray[Any]]) -> Iterator[bytes]:
    keypoint = np.empty(len(tracks.points), int)  # the index of an observation in its image
    error = np.empty(len(tracks.points))
    for view, rows in zip(views, by_view):
        keypoint[rows] = np.arange(len(rows))
        pixels, _ = view.camera.project(points[tracks.points[rows]])
        error[rows] = np.linalg.norm(pixels - tracks.pixels[rows], axis=1)
    order = np.argsort(tracks.points, kind="stable")
    ends = np.searchsorted(tracks.points[order], np.arange(1, len(points) + 1))
    seen = np.stack([tracks.views[order] + 1, keypoint[order]], axis=1).astype("<u4")
    yield struct.pack("<Q", len(points))
    begin = 0
    for number, end in enumerate(ends, 1):
        mean = error[order[begin:end]].mean() if end > begin else -1.0  # COLMAP: not computed
        yield struct.pack("<Q3d3BdQ", number, *points[number - 1],
                          *map(int, colours[number - 1]), mean, end - begin)
        yield seen[begin:end].tobytes()
        begin = end
