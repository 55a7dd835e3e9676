"""Reads reconstructions of OpenSfM, and so those of OpenDroneMap (ODM).

Format: https://opensfm.org/docs/dataset.html and https://opensfm.org/docs/geometry.html. Poses are
world to camera (angle-axis rotation, translation), camera axes right, down, forward. The world is
east, north, up in metres at `reference_lla`, or has z up without it. Image coordinates have their
origin in the middle of the photo and are divided by its longer side, so that they hold for the
photo in any size. The distortion of `brown` is in OpenCV's order, also in OpenSfM's code, though
its documentation leaves a square out.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.io.fields import number, numbers, pixels, reading, table, tables
from clsplat.io.photos.images import image_size
from clsplat.io.records import object_of
from clsplat.io.regular import read_regular
from clsplat.io.scenes import posed
from clsplat.io.scenes.projects.scene import OnEarth, PhotoFiles, project_scene, topocentric
from clsplat.scene import Scene

# ODM keeps OpenSfM's own result beside one that it has moved onto its map
NAMES = ("reconstruction.topocentric.json", "reconstruction.json")
ODM = "opensfm"  # the folder in a project of ODM
REFERENCE, TRACKS, MOVED = "reference_lla.json", "tracks.csv", "exported_geocoords.txt"
COORDINATES = ("latitude", "longitude", "altitude")
# projection_type -> models of COLMAP
MODELS = {
    **dict.fromkeys(("perspective", "simple_radial", "radial", "brown"), posed.BROWN),
    **dict.fromkeys(("fisheye", "fisheye_opencv"), posed.FISHEYE),
}
ASPECT = 2e-3  # relative tolerance of the ratio of a photo's sides: they may be rounded


def find_opensfm(path: Path) -> Path | None:
    """The reconstruction of a folder of OpenSfM or ODM, or the path itself if it is one."""
    if path.is_file():
        return path if path.name in NAMES else None
    places = (folder / name for folder in (path, path / ODM) for name in NAMES)
    return next((place for place in places if place.is_file()), None)


def read_opensfm(path: Path, images: str = "") -> Scene:
    """Read the scene of a reconstruction, the largest if there are several.

    Photos are in images/ of the project; observations are those of tracks.csv, if it is there.

    Parameters
    ----------
    path : of reconstruction.json.
    images : the folder of the photos, relative to the project's folder.
    """
    files = PhotoFiles(path.parent.parent if path.parent.name == ODM else path.parent, images)
    with reading(path, "a reconstruction of OpenSfM", "copy it again"):
        record, notes = _largest(path)
        shots, cameras, points = (table(record.get(key, {}), key) for key in ("shots", "cameras", "points"))
        photos = [_photo(shots[shot], cameras, *found) for shot, found in zip(shots, files.found(shots))]
        cloud = _points(points, path.parent, list(shots))
        reference = _reference(path, record)
        place = reference and OnEarth(topocentric(*reference), "", "OpenSfM")
        return project_scene(path, files, photos, cloud, place=place, z_is_up=True, notes=notes)


def _largest(path: Path) -> tuple[dict[str, Any], tuple[str, ...]]:
    """The reconstruction with the most photos, and notes about the others."""
    # a list, where `object_of` takes objects only
    found = tables(object_of(b'{"all": ' + read_regular(path) + b"}")["all"], "it")
    counts = [len(table(each.get("shots", {}), "shots")) for each in found]
    if not counts:
        raise ValueError("it holds no reconstruction")
    largest = int(np.argmax(counts))
    if len(counts) == 1:
        return found[0], ()
    return found[largest], (
        f"OpenSfM has split the scene into {len(counts)} parts; the largest, "
        f"with {counts[largest]} of {sum(counts)} photos, is used",
    )


def _photo(shot: Any, cameras: Mapping[str, Any], name: str, source: Path) -> posed.PosedPhoto:
    shot = table(shot, f"shot {name[:80]}")
    camera = table(cameras.get(str(shot.get("camera"))), f"the camera of shot {name[:80]}")
    rotation = scipy.spatial.transform.Rotation.from_rotvec(
        numbers(shot.get("rotation"), 3, f"the rotation of {name[:80]}")
    ).as_matrix()
    translation = numbers(shot.get("translation"), 3, f"the translation of {name[:80]}")
    return posed.PosedPhoto(name, source, _optics(camera, image_size(source)), rotation, -rotation.T @ translation)


def _optics(camera: Mapping[str, Any], photo: tuple[int, int]) -> posed.Optics:
    """The camera model of a photo of this size (width, height)."""
    size = pixels(camera.get("width"), "width"), pixels(camera.get("height"), "height")
    if abs(size[0] * photo[1] / (size[1] * photo[0]) - 1) <= ASPECT:
        size = photo  # others are refused later, with the reason
    kind, longer = camera.get("projection_type", "perspective"), float(max(size))

    def value(key: str) -> float:
        return number(camera.get(key, 0.0), key)

    both = "focal" if "focal" in camera else "focal_x"
    focal = longer * value(both), longer * value("focal" if "focal" in camera else "focal_y")
    centre = size[0] / 2 + longer * value("c_x"), size[1] / 2 + longer * value("c_y")
    if kind not in MODELS:
        raise ValueError(
            f"the camera model {str(kind)[:40]} is not read; reconstruct with perspective, brown or fisheye"
        )
    return posed.optics(size, focal, centre, MODELS[kind], {key: value(key) for key in posed.COEFFICIENTS})


def _points(points: Mapping[str, Any], folder: Path, shots: list[str]) -> posed.Cloud | None:
    if not points:
        return None
    rows = [
        [
            numbers(table(point, f"point {name[:40]}").get(key), 3, f"{key} of point {name[:40]}")
            for key in ("coordinates", "color")
        ]
        for name, point in points.items()
    ]
    positions, colours = np.array(rows).transpose(1, 0, 2)
    tracks = folder / TRACKS
    return posed.Cloud(
        positions,
        colours.clip(0, 255).round().astype(np.uint8),
        _observations(tracks, list(points), shots) if tracks.is_file() else None,
    )


def _observations(path: Path, points: list[str], shots: list[str]) -> NDArray[np.int64]:
    """int64[M, 2], rows (point, shot): columns 1 (shot) and 2 (point) of tracks.csv."""
    point, shot = ({name: row for row, name in enumerate(names)} for names in (points, shots))
    lines = read_regular(path).decode("utf-8", "replace").split("\n")
    rows = [
        (point[row[1]], shot[row[0]])
        for row in (line.split("\t") for line in lines)
        if len(row) > 2 and row[0] in shot and row[1] in point
    ]
    return np.array(rows, np.int64).reshape(-1, 2)


def _reference(path: Path, record: Mapping[str, Any]) -> tuple[float, float, float] | None:
    """Latitude, longitude and height of the origin; None if they are unknown, or if ODM has moved
    the reconstruction elsewhere."""
    if path.name == NAMES[1] and (path.parent / MOVED).exists():
        return None
    reference = record.get("reference_lla")
    if reference is None and (path.parent / REFERENCE).is_file():
        reference = object_of(read_regular(path.parent / REFERENCE))
    if reference is None:
        return None
    reference = table(reference, "reference_lla")
    latitude, longitude, height = (number(reference.get(key), key) for key in COORDINATES)
    return latitude, longitude, height
