"""Reads projects in Pix4D's Open Photogrammetry Format (OPF).

Format: https://pix4d.github.io/opf-spec. The project (.opf) lists items, whose resources are JSON
files: the photos (camera list), the sizes of their sensors (input cameras), calibrated cameras, the
coordinate system (scene reference frame), and the sparse points (glTF 2.0, buffers in files).
Coordinates are east, north and up; a shift leads from map coordinates to them. `orientation_deg` is
R = Rx(omega) Ry(phi) Rz(kappa), camera to world, with camera axes right, up, back. Pixels are
COLMAP's, and distortion is in OpenCV's order. A glTF node's matrix (column-major) leads from its
points to glTF's axes, in which y is up; OPF's have z up.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from clsplat.errors import reason
from clsplat.georeference import Georeference
from clsplat.io.fields import number, numbers, pixels, reading, table, tables, text
from clsplat.io.georeference.crs import is_local, project_crs
from clsplat.io.models.gltf import accessor
from clsplat.io.photos.images import image_size
from clsplat.io.records import object_of
from clsplat.io.regular import open_regular, read_regular
from clsplat.io.scenes.posed import FLIPPED, Cloud, Optics, PosedPhoto, brown, only
from clsplat.io.scenes.projects.scene import PhotoFiles, project_scene
from clsplat.scene import Scene

SUFFIX = ".opf"
FORMAT = "application/opf-{}+json"
VERSION = "1"  # before the first point
POINTS = "model/gltf+json"
Z_UP = np.array([(1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)])  # from axes with y up


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
        resources = _resources(path)
        calibrated = _object(resources, "calibrated-cameras")
        cameras = {_id(each): each for each in tables(calibrated.get("cameras", []), "cameras")}
        # the list may hold others, such as depth maps
        listed = {_id(each): each.get("uri") for each in tables(
            _object(resources, "camera-list").get("cameras", []), "cameras")}
        missing = set(cameras) - set(listed)
        if missing:
            raise ValueError(f"camera {min(missing)} has no photo")
        found = files.found((_path_of(listed[each]) for each in cameras),
                            resources[FORMAT.format("camera-list")].parent)
        sizes = {_id(sensor): numbers(sensor.get("image_size_px"), 2, "image_size_px")
                 for sensor in tables(_object(resources, "input-cameras", False).get("sensors", []),
                                      "sensors")}
        optics = {_id(sensor): sensor.get("internals")
                  for sensor in tables(calibrated.get("sensors", []), "sensors")}
        photos = [_photo(camera, optics, sizes, *photo)
                  for camera, photo in zip(cameras.values(), found)]
        points = _points(resources[POINTS]) if POINTS in resources else None
        georeference, notes = _georeference(
            _object(resources, "scene-reference-frame", False), len(photos))
        return project_scene(path, files, photos, points, place=georeference, z_is_up=True,
                             notes=notes)


def _resources(path: Path) -> dict[str, Path]:
    """The first file of each format; the points of a calibration are preferred to a dense cloud."""
    found = dict[str, Path]()
    items = tables(object_of(read_regular(path)).get("items", []), "items")
    for item in sorted(items, key=lambda item: item.get("type") != "calibration"):
        for each in tables(item.get("resources", []), "resources"):
            found.setdefault(str(each.get("format")), path.parent / _path_of(each.get("uri")))
    return found


def _object(resources: Mapping[str, Path], name: str, required: bool = True) -> dict[str, Any]:
    """The JSON object of a format; {} or ValueError if the project has none."""
    path = resources.get(FORMAT.format(name))
    if path is None:
        if required:
            raise ValueError(f"it has no {name.replace('-', ' ')}: calibrate the project")
        return {}
    try:
        record = object_of(read_regular(path))
        version = str(record.get("version", VERSION))
        if version.partition(".")[0] != VERSION:
            raise ValueError(f"version {version[:20]} of OPF is not read")
        return record
    except (OSError, ValueError) as error:
        raise ValueError(f"{path.name[:80]}: {reason(error)}") from None


def _id(record: Mapping[str, Any], key: str = "id") -> int:
    value = record.get(key)
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
    return unquote(parts.path)


def _photo(camera: Mapping[str, Any], optics: Mapping[int, Any],
           sizes: Mapping[int, NDArray[np.float64]], name: str, source: Path) -> PosedPhoto:
    sensor = _id(camera, "sensor_id")
    if sensor not in optics:
        raise ValueError(f"sensor {sensor} is missing")
    width, height = sizes[sensor].tolist() if sensor in sizes else image_size(source)
    return PosedPhoto(
        name, source, _optics(optics[sensor], (pixels(width, "width"), pixels(height, "height"))),
        rotation_of(numbers(camera.get("orientation_deg"), 3, "orientation_deg")).T,
        numbers(camera.get("position"), 3, "position"))


def rotation_of(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """float64[3, 3], camera (right, down, forward) to world, of omega, phi, kappa in degrees."""
    return np.asarray(Rotation.from_euler("XYZ", angles, degrees=True).as_matrix() * FLIPPED)


def _optics(internals: object, size: tuple[int, int]) -> Optics:
    internals = table(internals, "internals of a sensor")
    kind = internals.get("type")
    if kind != "perspective":
        raise ValueError(f"cameras of type {str(kind)[:40]} are not read, only perspective ones; "
                         "export undistorted photos")
    focal = number(internals.get("focal_length_px"), "focal_length_px")
    (x, y), radial, tangential = (
        numbers(internals.get(key), count, key).tolist() for key, count in (
            ("principal_point_px", 2), ("radial_distortion", 3), ("tangential_distortion", 2)))
    return brown(size, (focal, focal), (x, y), radial, tangential)


def _points(path: Path) -> Cloud | None:
    """The points of a glTF file; None if it has none."""
    try:
        document = object_of(read_regular(path))
        nodes = document["scenes"][document.get("scene", 0)].get("nodes", [])
        clouds = [_node(path.parent, document, document["nodes"][node]) for node in nodes]
    except (ValueError, TypeError, AttributeError, LookupError, OverflowError) as error:
        raise ValueError(f"{path.name[:80]}: {reason(error)}") from None
    positions = [positions for positions, _ in clouds]
    colours = [colours for _, colours in clouds if colours is not None]
    if not sum(map(len, positions)):
        return None
    return Cloud(np.concatenate(positions),
                 np.concatenate(colours) if len(colours) == len(clouds) else None)


def _node(folder: Path, document: dict[str, Any], node: Mapping[str, Any]
          ) -> tuple[NDArray[np.float64], NDArray[np.uint8] | None]:
    """The positions of a node's points in the scene, and their colours."""
    def content(buffer: dict[str, Any]) -> NDArray[np.uint8]:
        uri = unquote(text(buffer.get("uri"), "the uri of a buffer"))
        if uri.startswith("data:"):
            raise ValueError("a buffer is not in a file")
        with open_regular(folder / uri) as file:
            return np.memmap(file, np.uint8, "r")

    def values(name: str, width: int, kind: str) -> NDArray[Any]:
        found = accessor(document, attributes[name], width, content)
        if found.dtype != kind:
            raise ValueError(f"{name} is not of the right component type")
        return found

    primitive, = document["meshes"][node["mesh"]]["primitives"]
    attributes = primitive["attributes"]
    matrix = numbers(node.get("matrix", np.eye(4).ravel().tolist()), 16, "matrix")
    matrix = matrix.reshape(4, 4, order="F")
    local = values("POSITION", 3, "<f4")
    if not np.isfinite(local).all():
        raise ValueError("a position is not finite")
    positions = (local.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]) @ Z_UP.T
    if "COLOR_0" not in attributes:
        return positions, None
    colours = np.ascontiguousarray(values("COLOR_0", 4, "u1")[:, :3])
    if len(colours) != len(positions):
        raise ValueError("there are more or less colours than points")
    return positions, colours


def _georeference(frame: Mapping[str, Any], photos: int
                  ) -> tuple[Georeference | None, tuple[str, ...]]:
    """The georeference, if a scene reference frame has a CRS in metres, and notes."""
    crs, base = (table(frame.get(key, {}), key) for key in ("crs", "base_to_canonical"))
    definition = crs.get("definition", "")
    if not isinstance(definition, str):
        raise ValueError("the definition of the CRS is not text")
    scale = numbers(base.get("scale", [1.0] * 3), 3, "scale")
    east, north, height = (-numbers(base.get("shift", [0.0] * 3), 3, "shift")).tolist()
    if not frame or is_local(definition):
        return None, ()
    horizontal = project_crs(_with_authority(definition))
    if not horizontal or base.get("swap_xy") or (scale != 1).any():
        return None, ("the project's CRS is not a projected one in metres, east and north: its "
                      "coordinates are kept, without a map's",)
    return Georeference(horizontal, (east, north, height),
                        f"Pix4D's calibration of {photos} photos", 0.0), ()


def _with_authority(definition: str) -> str:
    """A CRS as pyproj reads it: "EPSG:32632+EPSG:5773" is "EPSG:32632+5773" there."""
    first, plus, second = definition.strip().partition("+")
    if plus and len(definition) < 60 and ":" in first:
        return f"{first}+{second.rpartition(':')[2]}"
    return definition
