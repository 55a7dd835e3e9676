"""Reads cameras that Agisoft Metashape exports as XML (File, Export, Export Cameras).

Format: Metashape's manual, appendix "Camera models", and its exports. `transform` of a camera is
camera to chunk, row-major, camera axes right, down, forward; `transform` of the camera's component,
or else of the chunk, leads to the world: scale * rotation @ x + translation, which are geocentric
coordinates if `reference` is a CRS, and local ones otherwise. (0.5, 0.5) is the middle of the first
pixel; cx and cy are relative to the middle of the photo. With x = X / Z and y = Y / Z (`frame`), or
these scaled to the angle from the axis (`fisheye`),

    u = width / 2 + cx + x' (f + b1) + y' b2,    v = height / 2 + cy + y' f
    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + p1 (r^2 + 2 x^2) + 2 p2 x y

and so y', with p1 and p2 exchanged: p1 is OpenCV's p2. The sparse points are not in the file.
"""

from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from clsplat.errors import InputError
from clsplat.io.fields import numbers, parsed, pixels, reading
from clsplat.io.regular import read_regular
from clsplat.io.scenes.posed import BROWN, FISHEYE, Optics, PosedPhoto, optics
from clsplat.io.scenes.projects.scene import OnEarth, PhotoFiles, project_scene
from clsplat.placement.alignment import Similarity
from clsplat.scene import Scene

HEAD_BYTES = 4096  # in which the file must show what it is
DISTORTION = ("b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")
IDENTITY = Similarity(1.0, np.eye(3), np.zeros(3))
LOCAL = ("LOCAL_CS", "ENGCRS", "ENGINEERINGCRS")  # how the WKT of local coordinates begins


def find_metashape(path: Path) -> Path | None:
    """The exported XML in a folder, or the path itself if it is one."""
    if path.is_file():
        return path if _is_export(path) else None
    found = sorted(filter(_is_export, path.glob("*.xml")))
    if len(found) > 1:
        raise InputError(
            f"{path}: holds several exports of Metashape's cameras: {found[0].name}, "
            f"{found[1].name}; give the file itself instead of its folder"
        )
    return found[0] if found else None


def _is_export(path: Path) -> bool:
    if path.suffix.lower() != ".xml" or not path.is_file():
        return False
    head = path.read_bytes()[:HEAD_BYTES]
    return b"<document" in head and b"<chunk" in head


def read_metashape(path: Path, images: str = "") -> Scene:
    """Read the scene of exported cameras; a photo's label may lack the suffix.

    Parameters
    ----------
    path : of the XML.
    images : the folder of the photos, relative to that of the XML.
    """
    files = PhotoFiles(path.parent, images)
    with reading(path, "cameras of Metashape", "export them again"):
        chunks = list(ElementTree.fromstring(read_regular(path)).iter("chunk"))
        if len(chunks) != 1:
            raise ValueError(f"it has {len(chunks)} chunks, and one is read")
        used, notes = _aligned(chunks[0])
        sensors = {sensor.get("id", ""): sensor for sensor in chunks[0].iter("sensor")}
        to_world = _transforms(chunks[0])
        photos = [
            _photo(camera, sensors, to_world, *found)
            for camera, found in zip(used, files.found(camera.get("label", "") for camera in used))
        ]
        definition = (chunks[0].findtext("reference") or "").strip()
        place = (
            None
            if not definition or definition.upper().startswith(LOCAL)
            else OnEarth(IDENTITY, definition, "Metashape")
        )
        return project_scene(path, files, photos, place=place, notes=notes)


def _aligned(chunk: Element) -> tuple[list[Element], tuple[str, ...]]:
    """The cameras with a pose that are enabled, and a note about the others."""
    cameras = list(chunk.iterfind("cameras//camera"))
    if any(camera.get("master_id") for camera in cameras):
        raise ValueError("rigs of several cameras are not read; export in COLMAP's format")
    used = [
        camera
        for camera in cameras
        if camera.find("transform") is not None and camera.get("enabled", "true").lower() not in ("false", "0")
    ]
    left = len(cameras) - len(used)
    note = f"{left} of {len(cameras)} photos of the project are not aligned or disabled: left out"
    return used, (note,) if left else ()


def _transforms(chunk: Element) -> dict[str, Similarity]:
    """The similarities to the world by the ids of components, each part of which may be missing;
    "" is that of the chunk."""
    found = {}
    for component in [chunk, *chunk.iterfind("components/component")]:
        transform = component.find("transform")
        if transform is None:
            continue
        scale, rotation, translation = (
            numbers(transform.findtext(key) or default, len(default.split()), key)
            for key, default in (("scale", "1"), ("rotation", "1 0 0 0 1 0 0 0 1"), ("translation", "0 0 0"))
        )
        if not scale[0] > 0:
            raise ValueError("scale is not positive")
        found["" if component is chunk else component.get("id", "")] = Similarity(
            float(scale[0]), rotation.reshape(3, 3), translation
        )
    return found


def _photo(
    camera: Element, sensors: Mapping[str, Element], to_world: Mapping[str, Similarity], name: str, source: Path
) -> PosedPhoto:
    try:
        pose = numbers(camera.findtext("transform") or "", 16, "transform").reshape(4, 4)
        world = to_world.get(camera.get("component_id", ""), to_world.get("", IDENTITY))
        if camera.get("sensor_id", "") not in sensors:
            raise ValueError("its sensor is missing")
        return PosedPhoto(
            name,
            source,
            _optics(sensors[camera.get("sensor_id", "")]),
            (world.rotation @ pose[:3, :3]).T,
            world(pose[:3, 3]),
        )
    except ValueError as error:
        raise ValueError(f"camera {camera.get('label', '')[:80]}: {error}") from None


def _optics(sensor: Element) -> Optics:
    kind = sensor.get("type", "frame")
    if kind not in ("frame", "fisheye"):
        raise ValueError(f"sensors of type {kind[:40]} are not read; export in COLMAP's format")
    calibrations = sorted(sensor.findall("calibration"), key=lambda each: each.get("class") != "adjusted")
    if not calibrations:
        raise ValueError("its sensor has no calibration")
    resolution = next(
        (found for each in (calibrations[0], sensor) if (found := each.find("resolution")) is not None), None
    )
    if resolution is None:
        raise ValueError("its sensor has no resolution")
    width, height = (pixels(parsed(resolution.get(key), key), key) for key in ("width", "height"))
    value = {key: parsed(calibrations[0].findtext(key) or "0", key) for key in ("f", "cx", "cy", "b1", *DISTORTION)}
    focal = value["f"] + value["b1"], value["f"]
    centre = width / 2 + value["cx"], height / 2 + value["cy"]
    value["p1"], value["p2"] = value["p2"], value["p1"]
    return optics(
        (width, height),
        focal,
        centre,
        BROWN if kind == "frame" else (*FISHEYE, "THIN_PRISM_FISHEYE"),
        {key: value[key] for key in DISTORTION},
    )
