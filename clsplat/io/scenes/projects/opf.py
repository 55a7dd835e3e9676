"""Reads projects in Pix4D's Open Photogrammetry Format (OPF).

Format: https://pix4d.github.io/opf-spec. The project (.opf) lists items, whose resources are JSON
files: the photos (camera list), the sizes of their sensors (input cameras), calibrated cameras, the
coordinate system (scene reference frame), and the sparse points (tracks).
Coordinates are east, north and up; a shift leads from map coordinates to them. `orientation_deg` is
R = Rx(omega) Ry(phi) Rz(kappa), camera to world, with camera axes right, up, back. Pixels are
COLMAP's. Radial and tangential distortion are in OpenCV's order. A fisheye has with t = 2 / pi *
(angle from the axis), rho = p0 + p1 t + p2 t^2 + ..., and its image [c d; e f] rho (x, y) / r.

Points are glTF 2.0 with buffers in files beside it. A node's matrix (column-major) leads from its
points to glTF's axes, in which y is up; OPF's have z up. The extension OPF_mesh_primitive_matches
lists the photos that show a point: a packed pair of 40 bits (the first of its matches) and 24 bits
(their number), and a photo for each match.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from clsplat.georeference import Georeference
from clsplat.io.fields import number, numbers, pixels, reading, table, tables, text
from clsplat.io.georeference.crs import is_local, project_crs
from clsplat.io.models.gltf import accessor
from clsplat.io.photos.images import image_size
from clsplat.io.reason import reason
from clsplat.io.records import object_of
from clsplat.io.regular import open_regular, read_regular
from clsplat.io.scenes.posed import FLIPPED, Cloud, Optics, PosedPhoto, brown, only
from clsplat.io.scenes.projects.scene import PhotoFiles, project_scene
from clsplat.scene import Scene

SUFFIX = ".opf"
FORMAT = "application/opf-{}+json"
VERSION = "1"  # before the first point
POINTS = "model/gltf+json"
MATCHES = "OPF_mesh_primitive_matches"
OFFSET_BITS = 40  # of the first of a point's matches
Z_UP = np.array([(1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)])  # from axes with y up
COEFFICIENTS = 4  # of a fisheye that COLMAP's OPENCV_FISHEYE has


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
        sensors = {_number(each): each for each in _objects(calibrated, "sensors")}
        sizes = _sizes(project)
        photos = [_photo(cameras[number], sensors, sizes, name, source)
                  for number, (name, source) in found.items()]
        # of the calibration, or of a point cloud
        tracks = project.paths(POINTS, "calibration") or project.paths(POINTS, "point_cloud")
        points = _points(tracks[0], list(found)) if tracks else None
        georeference, notes = _georeference(project, len(photos))
    return project_scene(path, files, path.parent, photos, points, place=georeference,
                         z_is_up=True, notes=notes)


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
            version = str(record.get("version", VERSION))
            if version.partition(".")[0] != VERSION:
                raise ValueError(f"version {version[:20]} of OPF is not read")
            return record
        except (OSError, ValueError) as error:
            raise ValueError(f"{paths[0].name[:80]}: {reason(error)}") from None


def _objects(record: Mapping[str, Any], key: str) -> list[dict[str, Any]]:
    return tables(record.get(key, []), key)


def _number(record: Mapping[str, Any], key: str = "id") -> int:
    """A unique id."""
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
    return dict(zip(cameras, files.found(
        (_path_of(listed[number]) for number in cameras), base)))


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
    """float64[3, 3], camera (right, down, forward) to world, of omega, phi, kappa in degrees."""
    return np.asarray(Rotation.from_euler("XYZ", angles, degrees=True).as_matrix() * FLIPPED)


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


def _points(path: Path, cameras: Sequence[int]) -> Cloud | None:
    """The points of a glTF file, with observations by these photos; None if it has none."""
    try:
        document = object_of(read_regular(path))
        nodes = document["scenes"][document.get("scene", 0)].get("nodes", [])
        clouds = [_node(path.parent, document, document["nodes"][node], cameras) for node in nodes]
    except (ValueError, TypeError, AttributeError, LookupError, OverflowError) as error:
        raise ValueError(f"{path.name[:80]}: {reason(error)}") from None
    positions = [cloud.positions for cloud in clouds]
    if not sum(map(len, positions)):
        return None
    begins = np.cumsum([0, *map(len, positions)])
    colours = [cloud.colours for cloud in clouds if cloud.colours is not None]
    observations = [cloud.observations + (begin, 0) for cloud, begin in zip(clouds, begins)
                    if cloud.observations is not None]
    return Cloud(np.concatenate(positions),
                 np.concatenate(colours) if len(colours) == len(clouds) else None,
                 np.concatenate(observations) if len(observations) == len(clouds) else None)


def _node(folder: Path, document: dict[str, Any], node: Mapping[str, Any], cameras: Sequence[int]
          ) -> Cloud:
    """The points of a node of the scene."""
    def content(buffer: dict[str, Any]) -> NDArray[np.uint8]:
        uri = unquote(text(buffer.get("uri"), "the uri of a buffer"))
        if uri.startswith("data:"):
            raise ValueError("a buffer is not in a file")
        with open_regular(folder / uri) as file:
            return np.memmap(file, np.uint8, "r")

    def values(number: int, width: int, kind: str) -> NDArray[Any]:
        found = accessor(document, number, width, content)
        if found.dtype != kind:
            raise ValueError(f"accessor {number} is not of the right component type")
        return found

    primitive, = document["meshes"][node["mesh"]]["primitives"]
    attributes, extensions = primitive["attributes"], primitive.get("extensions", {})
    matrix = numbers(node.get("matrix", np.eye(4).ravel().tolist()), 16, "matrix")
    matrix = matrix.reshape(4, 4, order="F")
    local = values(attributes["POSITION"], 3, "<f4")
    if not np.isfinite(local).all():
        raise ValueError("a position is not finite")
    positions = (local.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]) @ Z_UP.T
    colours = observations = None
    if "COLOR_0" in attributes:
        colours = np.ascontiguousarray(values(attributes["COLOR_0"], 4, "u1")[:, :3])
        if len(colours) != len(positions):
            raise ValueError("there are more or less colours than points")
    if MATCHES in extensions:
        matches = extensions[MATCHES]
        ranges = values(matches["pointIndexRanges"], 2, "<u4")
        if len(ranges) != len(positions):
            raise ValueError("there are more or less ranges of matches than points")
        observations = _observations(matches["cameraUids"], values(
            matches["cameraIds"], 1, "<u4")[:, 0], ranges, cameras)
    return Cloud(positions, colours, observations)


def _observations(uids: Sequence[object], indices: NDArray[Any], ranges: NDArray[Any],
                  cameras: Sequence[int]) -> NDArray[np.int64]:
    """int64[M, 2], rows (point, photo), of the ids of cameras, their indices and packed ranges."""
    packed = ranges[:, 0].astype(np.uint64) | ranges[:, 1].astype(np.uint64) << np.uint64(32)
    begins = (packed & np.uint64((1 << OFFSET_BITS) - 1)).astype(np.int64)
    counts = (packed >> np.uint64(OFFSET_BITS)).astype(np.int64)
    if (begins + counts > len(indices)).any() or counts.sum() > len(indices):
        raise ValueError("the ranges of matches are beyond their number")
    if len(indices) and indices.max() >= len(uids):
        raise ValueError("a match has a camera that is missing")
    place = {uid: row for row, uid in enumerate(cameras)}
    photo_of = np.array([place.get(uid if isinstance(uid, int) else -1, -1) for uid in uids],
                        np.int64)
    points = np.repeat(np.arange(len(ranges)), counts)
    within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    photos = photo_of[indices[begins.repeat(counts) + within]] if len(points) else points
    rows: NDArray[np.int64] = np.stack([points, photos], axis=1)[photos >= 0]
    return rows


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
    if not horizontal or base.get("swap_xy") or (scale != 1).any():
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
