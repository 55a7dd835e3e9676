"""Reads registrations that RealityScan (RealityCapture) exports: a CSV, or XMP files of photos.

Format: M. Hornacek, "On the Coordinate Systems Employed in the Import, Estimation, and Export of
Camera Geometry by RealityScan" (Epic Games, 2026). Lengths in the image are divided by its longer
side, with the origin in the middle; focal lengths are multiplied by 36. The Brown model is
OpenCV's with t1 and t2 exchanged; the division model, x / (1 + k1 r^2), is COLMAP's FULL_OPENCV
with its fourth radial coefficient alone. Rotations are world to camera, axes right, down, forward;
yaw, pitch and roll (heading is yaw) turn an aircraft from north, east, down, in the order ZYX, and
the camera looks down from it, with its top ahead. The three CSV files that are read:

    #name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2
    #name,x,y,alt,yaw,pitch,roll,f_35mm,px_norm,py_norm,k1,k2,k3,k4,t1,t2
    #name,tx,ty,tz,R00,...,R22,f_pix,px_pix,py_pix,k1,k2,t2,t1,k3,k4

The files hold no points and no CRS. RealityScan's export in COLMAP's format has both.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from clsplat.io.fields import numbers, parsed, reading
from clsplat.io.photos.images import image_size
from clsplat.io.reason import reason
from clsplat.io.regular import open_regular, read_regular
from clsplat.io.scenes.posed import Optics, PosedPhoto, brown, only
from clsplat.io.scenes.projects.photo_files import PhotoFiles, check_present
from clsplat.io.scenes.projects.scene import project_scene, root_of
from clsplat.io.scenes.sources import IMAGES, PHOTO_SUFFIXES
from clsplat.scene import Scene

HEAD_BYTES = 4096
NAMESPACE = "{http://www.capturingreality.com/ns/xcr/1.1#}"
DESCRIPTION = "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}Description"
MARK = b"capturingreality.com/ns/xcr"  # how an XMP file is recognised
# columns of the CSV files by the names that are used here
COLUMNS = {"heading": "yaw", "f": "f_35mm", "px": "px_norm", "py": "py_norm"}
ANGLES, MATRIX = ("x", "y", "alt", "yaw", "pitch", "roll"), ("tx", "ty", "tz", "r00", "r22")
COEFFICIENTS = ("k1", "k2", "k3", "k4", "t1", "t2")
TANGENTIAL = ("brown3t2", "brown4t2")
MODELS = ("", "none", "perspective", "division", "brown3", "brown4", *TANGENTIAL)
# camera axes (columns: right, down, forward) in those of the aircraft (nose, right wing, down), and
# the aircraft's north, east, down in east, north, up
MOUNT = np.array([(0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)])
NED = np.array([(0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)])


def find_realityscan(path: Path) -> Path | None:
    """The CSV of a folder, else the folder of XMP files, or the path itself if it is one."""
    if path.is_file():
        return path if _columns(path) else None
    table = only(filter(_columns, path.glob("*.csv")), "registrations of RealityScan")
    if table is not None:
        return table
    return next((folder for folder in (path / IMAGES, path) if _has_poses(folder)), None)


def read_realityscan(path: Path, images: str = "") -> Scene:
    """Read the scene of a CSV, or of a folder with XMP files.

    Parameters
    ----------
    path : of the CSV, or the folder of the XMP files and their photos.
    images : the folder of the photos, relative to that of the CSV, or to the project's folder.
    """
    folder = path.parent if path.is_file() or path.name == IMAGES else path
    files = PhotoFiles(folder, images)
    with reading(path, "a registration of RealityScan"):
        rows = _table(path) if path.is_file() else _sidecars(path)
        found = [files.find(name) for name in rows]
        check_present([source for _, source in found])
        photos = [_photo(row, name, source) for row, (name, source) in zip(rows.values(), found)]
    return project_scene(path, folder, files, photos)


Row = Mapping[str, str]  # the texts of a camera by the names of columns


def _columns(path: Path) -> list[str]:
    """The names of a CSV's columns, in lower case; [] if it is no registration."""
    try:
        with open_regular(path) as file:
            lines = file.read(HEAD_BYTES).decode("utf-8-sig", "replace").splitlines()
    except OSError:
        return []
    for line in lines[:3]:  # "#cameras 40" may stand before them
        if line.lower().replace(" ", "").startswith("#name,"):
            # the OpenCV form explains its columns behind the last
            named = line.lstrip("# ").partition("(")[0].lower().split(",")
            names = [COLUMNS.get(name.strip(), name.strip()) for name in named]
            return names if {*ANGLES} <= {*names} or {*MATRIX} <= {*names} else []
    return []


def _table(path: Path) -> dict[str, Row]:
    """The rows of a CSV by the names of photos."""
    names = _columns(path)
    rows: dict[str, Row] = {}
    text = read_regular(path).decode("utf-8-sig", "replace")
    try:
        for values in csv.reader(text.splitlines()):
            if not values or values[0].startswith("#"):
                continue
            if len(values) < len(names):
                raise ValueError(f"the row of {values[0][:80]} has {len(values)} values, "
                                 f"not {len(names)}")
            row = dict(zip(names, values))
            if row["name"] in rows:
                raise ValueError(f"photo {row['name'][:80]} occurs twice")
            rows[row["name"]] = row
    except csv.Error as error:
        raise ValueError(reason(error)) from None
    return rows


def _has_poses(folder: Path) -> bool:
    """Whether the first XMP files of a folder include one of RealityScan."""
    def is_pose(path: Path) -> bool:
        try:
            return MARK in read_regular(path)[:HEAD_BYTES]
        except OSError:
            return False
    return any(map(is_pose, sorted(folder.glob("*.xmp"))[:20]))


def _sidecars(folder: Path) -> dict[str, Row]:
    """The poses in XMP files, by the names of their photos."""
    rows: dict[str, Row] = {}
    for path in sorted(folder.glob("*.xmp")):
        data = read_regular(path)
        if MARK not in data:
            continue
        try:
            row = _sidecar(data)
        except ValueError as error:
            raise ValueError(f"{path.name[:80]}: {reason(error)}") from None
        if row:
            photos = (path.with_suffix(suffix) for suffix in PHOTO_SUFFIXES)
            photos = (spelled for photo in photos
                      for spelled in (photo, photo.with_suffix(photo.suffix.upper())))
            rows[next((photo.name for photo in photos if photo.is_file()), path.stem)] = row
    return rows


def _sidecar(data: bytes) -> Row:
    """The camera in an XMP file; empty without a pose. Values are attributes or elements,
    as the version of the program has it."""
    row: dict[str, str] = {}
    for description in root_of(data).iter(DESCRIPTION):
        pairs = [*description.items(), *((each.tag, each.text or "") for each in description)]
        row |= {key.removeprefix(NAMESPACE): value.strip() for key, value in pairs
                if isinstance(key, str) and key.startswith(NAMESPACE)}
    if not {"Rotation", "Position", "FocalLength35mm"} <= {*row}:
        return {}
    if row.get("Coordinates", "absolute") != "absolute":
        raise ValueError("its pose is relative to a rig; export absolute poses")
    return row


def _photo(row: Row, name: str, source: Path) -> PosedPhoto:
    size = image_size(source)
    try:
        if "Rotation" in row:
            rotation = numbers(row["Rotation"], 9, "Rotation").reshape(3, 3)
            return PosedPhoto(name, source, _xmp_optics(row, size), rotation,
                                numbers(row["Position"], 3, "Position"))
        if "r00" in row:
            rotation = np.array([[parsed(row.get(f"r{i}{j}"), f"R{i}{j}") for j in range(3)]
                                 for i in range(3)])
            translation = np.array([parsed(row[key], key) for key in MATRIX[:3]])
            return PosedPhoto(name, source, _csv_optics(row, size), rotation,
                                -rotation.T @ translation)
        *position, yaw, pitch, roll = (parsed(row[key], key) for key in ANGLES)
        return PosedPhoto(name, source, _csv_optics(row, size),
                            rotation_of(yaw, pitch, roll).T, np.array(position))
    except ValueError as error:
        raise ValueError(f"{name[:80]}: {error}") from None


def rotation_of(yaw: float, pitch: float, roll: float) -> NDArray[np.float64]:
    """float64[3, 3], from a camera to east, north and up, of angles in degrees."""
    turned = Rotation.from_euler("ZYX", (yaw, pitch, roll), degrees=True).as_matrix()
    rotation: NDArray[np.float64] = NED @ turned @ MOUNT
    return rotation


def _csv_optics(row: Row, size: tuple[int, int]) -> Optics:
    longer = max(size)
    if "f_pix" in row:
        focal, *centre = (parsed(row.get(key), key) for key in ("f_pix", "px_pix", "py_pix"))
    else:
        focal = longer * parsed(row.get("f_35mm"), "f") / 36
        centre = [side / 2 + longer * parsed(row.get(key, "0"), key)
                  for side, key in zip(size, ("px_norm", "py_norm"))]
    values = [parsed(row.get(key, "0"), key) for key in COEFFICIENTS]
    return _optics(size, (focal, focal), (centre[0], centre[1]), values, division=False)


def _xmp_optics(row: Row, size: tuple[int, int]) -> Optics:
    longer = max(size)
    if parsed(row.get("Skew", "0"), "Skew") or parsed(row.get("AspectRatio", "1"), "Aspect") != 1:
        raise ValueError("its pixels are not square; align without skew and aspect ratio (models "
                         "K+Brown)")
    focal = longer * parsed(row["FocalLength35mm"], "FocalLength35mm") / 36
    x, y = (side / 2 + longer * parsed(row.get(f"PrincipalPoint{axis}", "0"), "PrincipalPoint")
            for side, axis in zip(size, "UV"))
    model = row.get("DistortionModel", "")
    if model not in MODELS:
        raise ValueError(f"the distortion model {model[:40]} is not read; choose Brown3 or Brown4")
    values = numbers(row.get("DistortionCoeficients", "0 0 0 0 0 0"), 6, "DistortionCoeficients")
    if model not in MODELS[3:]:
        values[:] = 0
    if model not in TANGENTIAL:
        values[4:] = 0
    if model.startswith("brown3") and values[3]:
        raise ValueError("the distortion model brown3 has no coefficient k4; export it again")
    return _optics(size, (focal, focal), (x, y), values.tolist(), model == "division")


def _optics(size: tuple[int, int], focal: tuple[float, float], centre: tuple[float, float],
            values: Sequence[float], division: bool) -> Optics:
    """The camera model with k1 to k4, t1, t2."""
    k1, k2, k3, k4, t1, t2 = values
    if division and k1:
        return Optics(size, focal, centre, ("FULL_OPENCV", (
            *focal, *centre, 0.0, 0.0, 0.0, 0.0, 0.0, k1, 0.0, 0.0)))
    return brown(size, focal, centre, () if division else (k1, k2, k3, k4),
                 (0.0, 0.0) if division else (t2, t1))
