"""Reads projects in Pix4D's Open Photogrammetry Format (OPF).

Format: https://pix4d.github.io/opf-spec. The project (.opf) lists items, whose resources are JSON
files: the photos (camera list), the sizes of their sensors (input cameras), calibrated cameras, the
coordinate system (scene reference frame), and the sparse points (tracks, `opf_points.py`).
Coordinates are east, north and up; a shift leads from map coordinates to them. `orientation_deg` is
R = Rx(omega) Ry(phi) Rz(kappa), camera to world, with camera axes right, up, back. Pixels are
COLMAP's. Radial and tangential distortion are in OpenCV's order. A fisheye has with t = 2 / pi *
(angle from the axis), rho = p0 + p1 t + p2 t^2 + ..., and its image [c d; e f] rho (x, y) / r.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from clsplat.georeference import Georeference
from clsplat.io.fields import number, numbers, pixels, reading, table, tables
from clsplat.io.georeference.crs import is_local, project_crs
from clsplat.io.photos.images import image_size
from clsplat.io.reason import reason
from clsplat.io.records import object_of
from clsplat.io.regular import read_regular
from clsplat.io.scenes.posed import FLIPPED, Optics, PosedPhoto, brown, only
from clsplat.io.scenes.projects.opf_points import read_points
from clsplat.io.scenes.projects.photo_files import PhotoFiles, check_present
from clsplat.io.scenes.projects.scene import project_scene
from clsplat.scene import Scene

SUFFIX = ".opf"
FORMAT = "application/opf-{}+json"
VERSIONS = ("0", "1")  # before the first point: drafts of the format, and itself
POINTS = "model/gltf+json"
COEFFICIENTS = 4  # of a fisheye that COLMAP's OPENCV_FISHEYE has
UNIT = np.ones(3)


def find_opf(path: Path) -> Path | None:
    """The project in a folder, or the path itself if it is one."""
    if path.is_file():
        return path if path.suffix.lower() == SUFFIX else None
    return only(path.glob(f"*{SUFFIX}"), "projects of OPF")


def read_opf(path: Path, images: str = "") -> Scene:
    """Read the scene of a project.

    Parameters
    ----------
    path : of the .opf file.
    images : the folder of the photos, relative to the project's folder.
    """
    files = PhotoFiles(path.parent, images)
    with reading(path, "a project in OPF"):
        project = _Project(path)
        calibrated = project.object("calibrated-cameras")
        cameras = {_number(each): each for each in _objects(calibrated, "cameras")}
        found = _find_photos(project, files, cameras)
        check_present([source for _, source in found.values()])
        sensors = {_number(each): each for each in _objects(calibrated, "sensors")}
        sizes = _sizes(project)
        photos = [_photo(cameras[number], sensors, sizes, name, source)
                  for number, (name, source) in found.items()]
        tracks = project.tracks()
        points = tracks and read_points(tracks, list(found))
        georeference, notes = _georeference(project, len(photos))
    return project_scene(path, path.parent, files, photos, points or None,
                         georeference=georeference, z_is_up=True, notes=notes)


class _Project:
    """The resources of a project."""

    def __init__(self, path: Path) -> None:
        self.folder = path.parent
        self.items = _objects(object_of(read_regular(path)), "items")

    def paths(self, form: str, item: str = "") -> list[Path]:
        """The files of a format, in items of a type."""
        return [self.folder / _path_of(resource.get("uri")) for each in self.items
                if item in ("", each.get("type")) for resource in _objects(each, "resources")
                if resource.get("format") == form]

    def object(self, name: str, required: bool = True) -> dict[str, Any]:
        """The JSON object of a format; {} or ValueError if the project has none."""
        paths = self.paths(FORMAT.format(name))
        if not paths:
            if required:
                raise ValueError(f"it has no {name.replace('-', ' ')}: calibrate the project")
            return {}
        try:
            record = object_of(read_regular(paths[0]))
            version = str(record.get("version", VERSIONS[-1]))
            if version.partition(".")[0] not in VERSIONS:
                raise ValueError(f"version {version[:20]} of OPF is not read")
            return record
        except (OSError, ValueError) as error:
            raise ValueError(f"{paths[0].name[:80]}: {reason(error)}") from None

    def tracks(self) -> Path | None:
        """The file of the sparse points of the calibration, or of a point cloud."""
        found = self.paths(POINTS, "calibration") or self.paths(POINTS, "point_cloud")
        return found[0] if found else None


def _objects(record: Mapping[str, Any], key: str) -> list[dict[str, Any]]:
    return tables(record.get(key, []), key)


def _number(record: Mapping[str, Any], key: str = "id") -> int:
    """A unique id, which drafts of the format write as text in hexadecimal."""
    value = record.get(key)
    if isinstance(value, str) and len(value) < 40:
        return int(value, 0)
    if type(value) is not int:
        raise ValueError(f"{key} is not an id")
    return value


def _path_of(uri: object) -> str:
    """The path of a URI reference, without the page of a photo."""
    if not isinstance(uri, str) or "\0" in uri:
        raise ValueError("a uri is not valid text")
    parts = urlsplit(uri)
    if parts.scheme not in ("", "file"):
        raise ValueError(f"{uri[:80]!r} is not a file")
    path = unquote(parts.path)
    if "\0" in path:
        raise ValueError("a uri is not valid text")
    return path


def _find_photos(project: _Project, files: PhotoFiles, cameras: Mapping[int, object]
                 ) -> dict[int, tuple[str, Path]]:
    """The photos of calibrated cameras, by id; the list may hold others, such as depth maps."""
    folder = project.paths(FORMAT.format("camera-list"))
    base = folder[0].parent if folder else project.folder
    listed = {_number(each): each.get("uri")
              for each in _objects(project.object("camera-list"), "cameras")}
    missing = set(cameras) - set(listed)
    if missing:
        raise ValueError(f"camera {min(missing)} has no photo")
    return {number: files.find(_path_of(listed[number]), base) for number in cameras}


def _sizes(project: _Project) -> dict[int, tuple[int, int]]:
    """The sizes of photos by the ids of their sensors, as far as they are known."""
    sizes = {}
    for sensor in _objects(project.object("input-cameras", required=False), "sensors"):
        width, height = numbers(sensor.get("image_size_px"), 2, "image_size_px")
        sizes[_number(sensor)] = pixels(width, "width"), pixels(height, "height")
    return sizes


def _photo(camera: Mapping[str, Any], sensors: Mapping[int, Mapping[str, Any]],
           sizes: Mapping[int, tuple[int, int]], name: str, source: Path) -> PosedPhoto:
    number = _number(camera, "sensor_id")
    if number not in sensors:
        raise ValueError(f"sensor {number} is missing")
    size = sizes[number] if number in sizes else image_size(source)
    return PosedPhoto(
        name, source, _optics(sensors[number].get("internals"), size),
        rotation_of(numbers(camera.get("orientation_deg"), 3, "orientation_deg")).T,
        numbers(camera.get("position"), 3, "position"))


def rotation_of(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """float64[3, 3], from the camera (right, down, forward) to the world, of omega, phi, kappa in
    degrees."""
    rotation: NDArray[np.float64] = Rotation.from_euler(
        "XYZ", angles, degrees=True).as_matrix() * FLIPPED
    return rotation


def _optics(internals: object, size: tuple[int, int]) -> Optics:
    internals = table(internals, "internals of a sensor")
    x, y = numbers(internals.get("principal_point_px"), 2, "principal_point_px").tolist()
    kind = internals.get("type")
    if kind == "perspective":
        focal = number(internals.get("focal_length_px"), "focal_length_px")
        return brown(size, (focal, focal), (x, y), numbers(
            internals.get("radial_distortion"), 3, "radial_distortion").tolist(), numbers(
            internals.get("tangential_distortion"), 2, "tangential_distortion").tolist())
    if kind != "fisheye":
        raise ValueError(f"cameras of type {str(kind)[:40]} are not read; only perspective and "
                         "fisheye are")
    c, d, e, f = numbers(internals.get("affine"), 4, "affine").tolist()
    values = internals.get("polynomial")
    polynomial = numbers(values, len(values) if isinstance(values, list) else 0, "polynomial")
    if d or e or polynomial[::2].any() or len(polynomial) > 2 * (COEFFICIENTS + 1):
        raise ValueError("no camera model of COLMAP has the even powers or the shear of this "
                         "fisheye; export undistorted photos")
    if len(polynomial) < 2 or not polynomial[1]:
        raise ValueError("polynomial has no linear term")
    # t is 2 / pi of COLMAP's angle
    odd = polynomial[1::2] * (2 / np.pi) ** np.arange(1, len(polynomial), 2)
    ks = np.zeros(COEFFICIENTS)
    ks[:len(odd) - 1] = odd[1:] / odd[0]
    focal_x, focal_y = c * float(odd[0]), f * float(odd[0])
    return Optics(size, (focal_x, focal_y), (x, y),
                  ("OPENCV_FISHEYE", (focal_x, focal_y, x, y, *ks.tolist())))


def _georeference(project: _Project, photos: int
                  ) -> tuple[Georeference | None, tuple[str, ...]]:
    """The georeference, if the project has a CRS in metres, and notes."""
    frame = project.object("scene-reference-frame", required=False)
    if not frame:
        return None, ()
    crs, base = (table(frame.get(key, {}), key) for key in ("crs", "base_to_canonical"))
    definition = crs.get("definition", "")
    if not isinstance(definition, str):
        raise ValueError("the definition of the CRS is not text")
    scale = numbers(base.get("scale", [1.0] * 3), 3, "scale")
    shift = numbers(base.get("shift", [0.0] * 3), 3, "shift")
    if is_local(definition):
        return None, ()
    horizontal = project_crs(_with_authority(definition))
    if not horizontal or base.get("swap_xy") or (scale != UNIT).any():
        return None, ("the project's CRS is not a projected one in metres, east and north: its "
                      "coordinates are kept, without a map's",)
    east, north, height = (-shift).tolist()
    return Georeference(horizontal, (east, north, height),
                        f"Pix4D's calibration of {photos} photos", 0.0), ()


def _with_authority(definition: str) -> str:
    """A CRS as pyproj reads it: "EPSG:32632+EPSG:5773" is "EPSG:32632+5773" there."""
    first, plus, second = definition.strip().partition("+")
    if plus and len(definition) < 60 and ":" in first:
        return f"{first}+{second.rpartition(':')[2]}"
    return definition
