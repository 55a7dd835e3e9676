"""What lies beside photos and scenes, under fuzz: metadata, places, masks, depths, paths."""

import functools

import numpy as np
import OpenImageIO as oiio

from clsplat.camera import Camera
from clsplat.export.camera_path import interpolated, read_camera_path
from clsplat.georeference import Georeference
from clsplat.io.georeference.control_points import read_control_points
from clsplat.io.georeference.files import (
    read_georeference,
    read_orientation,
    write_georeference,
    write_orientation,
)
from clsplat.io.georeference.geojson import read_polygons
from clsplat.io.photos.depth import read_depth
from clsplat.io.photos.lenses import undistorted_model
from clsplat.io.photos.metadata import read_metadata
from clsplat.io.photos.photo import opened
from clsplat.io.photos.views import read_valid
from clsplat.io.scenes.read import read_scene
from clsplat.scene import View
from tests.adversarial.fuzz.reader import Reader
from tests.data.layouts import camera_angle, write_json, write_transforms
from tests.data.tiny_model import write_scene
from tests.io.photos.test_lenses import arrays_of
from tests.io.photos.test_metadata import GPS, photo

DJI = {"GimbalYawDegree": "+12.50", "GimbalPitchDegree": "-89.90", "GimbalRollDegree": "+0.00",
       "RelativeAltitude": "+60.1", "RtkStdLon": "0.01", "RtkStdLat": "0.01", "RtkStdHgt": "0.02",
       "CalibratedFocalLength": "3666.0", "DewarpData": "2020-01-01;3.6,3.6,1,1,0,0,0,0,0"}
EXIF = {**GPS, "Exif:FocalLength": 8.8, "Exif:FocalLengthIn35mmFilm": 24, "Make": "DJI",
        "Model": "FC6310", "DateTime": "2020:01:02 03:04:05", "Orientation": 6}
SIZE, LENS = (24, 18), (20.0, 20.0, 11.5, 9.5, -0.1, 0.02, 1e-3, -2e-3)


def _finite(*values):
    assert all(value is None or np.isfinite(value).all() for value in values)


def _metadata(folder):
    for number, (exif, xmp) in enumerate(((EXIF, DJI), (EXIF, None), ({}, DJI))):
        (folder / str(number)).mkdir()
        photo(folder / str(number) / "photo.jpg", exif, xmp, size=(24, 16))
        yield folder / str(number)


def _read_metadata(folder):
    data = read_metadata(folder / "photo.jpg")
    _finite(data.latitude, data.longitude, data.altitude, data.gps_std, data.focal_pixels,
            data.gimbal_pitch)
    assert data.width > 0 and data.height > 0
    assert data.latitude is None or abs(data.latitude) <= 90


def _georeferences(folder):
    view = Camera.looking_at((0, 0, 0), (1, 2, 3))
    for number, crs in enumerate(("EPSG:32632", 'PROJCRS["made"]')):
        seed = folder / str(number)
        seed.mkdir()
        write_georeference(seed, Georeference(crs, (5e5, 5.3e6, 200.0), "made", 0.1))
        write_orientation(seed, (0.0, 0.6, 0.8), view if number else None)
        yield seed


def _georeference(folder):
    place, orientation = read_georeference(folder), read_orientation(folder)
    if place is not None:
        _finite(place.offset, place.residual)
    if orientation is not None:
        up, view = orientation
        assert np.linalg.norm(up) > 0.99
        if view is not None:
            _finite(view.position, view.focal, view.centre)


def _control_points(folder):
    for number, lines in enumerate((
            ("EPSG:32632", "500010.5 5300020 210 100 200 a.jpg one", "500010.5 5300020 210 120 190 "
             "b.jpg one", "500050 5300090 212 10 20 a.jpg two"),
            ("EPSG:4326", "name,x,y,z,pixel_x,pixel_y,image", "one,9.0,47.8,210,100,200,a.jpg",
             "two,9.001,47.801,212,10,20,a.jpg"))):
        (folder / str(number)).mkdir()
        (folder / str(number) / "gcp.txt").write_text("\n".join(lines) + "\n")
        yield folder / str(number)


def _read_control_points(folder):
    read = read_control_points(folder / "gcp.txt")
    assert read.crs and read.points
    for point in read.points:
        _finite(point.position, *(mark[1:] for mark in point.marks))


@functools.cache
def _lens():
    """A lens with distortion."""
    model = undistorted_model("made", arrays_of(["photo.png"], SIZE), [("OPENCV", LENS)])
    return model["lenses"][0]


def _views(photo, **beside):
    """The view of a photo by a pinhole camera of half its size, and that by a lens."""
    lens, (width, height) = _lens(), SIZE
    for size, known in (((width // 2, height // 2), None), ((lens.width, lens.height), lens)):
        camera = Camera.looking_at((0, 0, 0), (1, 2, 3), width=size[0], height=size[1])
        yield View(photo.name, camera, photo, known, **beside)


def _masks(folder):
    """A photo and its mask: in grey, in colours, and with alpha in the photo."""
    random = np.random.default_rng(0)
    for number, channels in enumerate((1, 3, 4)):
        seed = folder / str(number)
        (seed / "masks").mkdir(parents=True)
        _write(seed / "photo.png", random.integers(0, 256, (18, 24, max(channels, 3)), np.uint8))
        _write(seed / "masks/photo.png", random.integers(0, 256, (18, 24, channels), np.uint8))
        yield seed


def _read_masks(folder):
    photo = folder / "photo.png"
    with opened(photo) as header:
        transparent = header.has_alpha
    for view in _views(photo, mask=folder / "masks/photo.png", transparent=transparent):
        valid = read_valid(view)
        assert valid is None or valid.shape == (view.camera.height, view.camera.width)


def _depths(folder):
    """A photo and its depth map in each format."""
    depth = np.random.default_rng(0).uniform(1, 9, (9, 12, 1)).astype(np.float32)
    for number, (suffix, values) in enumerate((
            (".npy", depth), (".npy", 1000 * depth), (".tif", depth), (".exr", depth),
            (".png", 1000 * depth), (".tif", 1000 * depth))):
        seed = folder / str(number)
        seed.mkdir()
        _write(seed / "photo.jpg", np.zeros((18, 24, 3), np.uint8))
        values = values if values is depth else values.astype(np.uint16)
        if suffix == ".npy":
            np.save(seed / "photo.npy", values[..., 0])
        else:
            _write(seed / f"photo{suffix}", values)
        yield seed


def _write(path, values):
    output = oiio.ImageOutput.create(str(path))
    kind = {"uint8": oiio.UINT8, "uint16": oiio.UINT16, "float32": oiio.FLOAT}[values.dtype.name]
    height, width, channels = values.shape
    spec = oiio.ImageSpec(width, height, channels, kind)
    spec.attribute("DateTime", "2026:01:02 03:04:05")  # else EXR has the present time
    assert output.open(str(path), spec)
    assert output.write_image(values) and output.close()


def _read_depths(folder):
    photo = folder / "photo.jpg"
    path, = (path for path in folder.iterdir() if path != photo)
    for view in _views(photo, depth=path):
        depth = read_depth(view)
        assert depth.shape == (view.camera.height, view.camera.width)
        assert np.isfinite(depth).all() and (depth >= 0).all()


def _camera_paths(folder):
    scene = read_scene(write_scene(folder / "made"))
    for number in range(2):
        seed = folder / str(number)
        table = write_transforms(folder / "other", scene)
        frames = [{"transform_matrix": frame["transform_matrix"], "time": 2.0 * at}
                  for at, frame in enumerate(table["frames"])]
        angle = camera_angle(scene) if number else {}
        write_json(seed / "path.json", {**angle, "frames": frames if number else [
            {"transform_matrix": frame["transform_matrix"]} for frame in frames]})
        yield seed


def _camera_path(folder):
    keys = read_camera_path(folder / "path.json")
    for camera in interpolated(keys, np.linspace(0, 1, 5), (64, 48), 60.0):
        _finite(camera.position, camera.rotation, camera.focal)


def _polygons(folder):
    ring = [[0, 0], [4, 0], [4, 3], [0, 3], [0, 0]]
    hole = [[1, 1], [2, 1], [2, 2], [1, 1]]
    feature = {"type": "Feature", "properties": {"name": "a"},
               "geometry": {"type": "Polygon", "coordinates": [ring, hole]}}
    for number, record in enumerate((
            {"type": "FeatureCollection", "features": [feature, {**feature, "geometry": None}],
             "crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32632"}}},
            {"type": "GeometryCollection", "geometries": [
                {"type": "MultiPolygon", "coordinates": [[ring], [hole]]}]})):
        write_json(folder / str(number) / "area.geojson", record)
        yield folder / str(number)


def _read_polygons(folder):
    polygons, crs = read_polygons(folder / "area.geojson")
    assert polygons and isinstance(crs, str)
    for polygon in polygons:
        for ring in polygon:
            _finite(ring)
            assert ring.shape[1] == 2


READERS = {
    "metadata": Reader(_metadata, _read_metadata, files=(".jpg",)),
    "georeference": Reader(_georeferences, _georeference, text=True, files=(".json",)),
    "gcp": Reader(_control_points, _read_control_points, text=True, files=(".txt",)),
    "masks": Reader(_masks, _read_masks, files=(".png",)),
    "depths": Reader(_depths, _read_depths, files=(".npy", ".tif", ".exr", ".png")),
    "camera-path": Reader(_camera_paths, _camera_path, text=True, files=(".json",)),
    "geojson": Reader(_polygons, _read_polygons, text=True, files=(".geojson",)),
}
