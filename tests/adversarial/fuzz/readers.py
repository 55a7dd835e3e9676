"""The readers under fuzz: how the valid files of each are made, and how a mutated one is read.

A seed is a small folder, {relative path: bytes}; `read` takes such a folder with one file mutated.
What a reader accepts must be usable, so `read` also looks at what it got: an assertion that fails
is a fault as much as a traceback.
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from clsplat.apps.measure import measure
from clsplat.camera import Camera
from clsplat.gaussians import Gaussians
from clsplat.georeference import Georeference
from clsplat.io.georeference import files as places
from clsplat.io.georeference.control_points import read_control_points
from clsplat.io.georeference.files import read_georeference, write_georeference, write_orientation
from clsplat.io.georeference.geojson import read_features
from clsplat.io.models.formats import read_model, write_model
from clsplat.io.models.ply import read_ply, write_ply
from clsplat.io.photos.metadata import read_metadata
from clsplat.io.photos.views import read_photo
from clsplat.io.scenes.read import fingerprint, read_scene
from clsplat.options import from_toml, resolve
from tests.adversarial.fuzz.photos import (
    DNGS,
    HEICS,
    decoded,
    finite,
    made_decoded,
    made_images,
    made_with_profiles,
    numbered,
    read_pixels,
)
from tests.data import layouts, projects, surfaces
from tests.data.decoded_photos import write_dng, write_heic
from tests.data.tiny_model import reconstruction, write_scene
from tests.io.photos.test_metadata import GPS, photo


@dataclass(frozen=True)
class Reader:
    """make: called with an empty folder, yields those below it that are seeds; read: called with a
    seed's folder; text: whether its files are lines of fields; files: suffixes of those mutated."""

    make: Callable
    read: Callable
    text: bool = False
    files: tuple[str, ...] = ("",)

    def seeds(self):
        """List of {relative path: bytes}, the same whenever it is called."""
        with tempfile.TemporaryDirectory(prefix="clsplat-fuzz-") as folder:
            return [
                {
                    file.relative_to(seed).as_posix(): file.read_bytes()
                    for file in sorted(seed.rglob("*"))
                    if file.is_file()
                }
                for seed in self.make(Path(folder))
            ]


def usable(scene):
    """A scene that was accepted can be trained."""
    assert scene.views and len(scene.points) == len(scene.colours)
    assert np.isfinite(scene.points).all() and np.isfinite(scene.offset).all()
    assert 0 < scene.extent < np.inf and scene.near_plane > 0
    for view in scene.views:
        camera = view.camera
        numbers = (camera.width, camera.height, *camera.focal, *camera.centre)
        assert np.isfinite(numbers).all() and np.isfinite(camera.position).all()
        camera.reduced(2)
        assert read_photo(view).shape == (camera.height, camera.width, 3)
    assert len(fingerprint(scene)) == 64
    if scene.observations is not None:
        assert scene.observations.min() >= 0
        assert (scene.observations.max(axis=0) < (len(scene.points), len(scene.views))).all()


def gaussians_like(count, degree, seed=0):
    """Gaussians with random values in all rows."""
    random = np.random.default_rng(seed)
    made = Gaussians.from_points(
        random.normal(size=(count, 3)), random.integers(0, 256, (count, 3), dtype=np.uint8), degree
    )
    rows = {**made.rows, "anchors": made.positions + 1, "max_offsets": made.opacity_logits + 9}
    return Gaussians(rows, degree)


def check(gaussians):
    """Gaussians that were accepted can be rendered."""
    for values in gaussians.rows.values():
        assert values.dtype in (np.float32, np.float64) and len(values) == gaussians.count
        assert np.isfinite(values).all()


PLACE = Georeference("EPSG:32632", (5e5, 5.3e6, 200.0), "made", 0.1)


def _model(suffix, version=0):
    """The reader of a format, whose seeds are one file each."""

    def make(folder):
        for seed, (count, degree) in numbered(folder, ((6, 0), (300, 3))):
            model = gaussians_like(count, degree).located(np.array([2.0, 3.0, 4.0]) * (degree > 0))
            write_model(
                seed / f"model{suffix}",
                model,
                ("made",),
                np.array([0.0, 0.0, 1.0]),
                PLACE if degree and suffix == ".las" else None,
                version,
            )
            yield seed

    return Reader(make, lambda folder: check(read_model(folder / f"model{suffix}")), files=(suffix,))


def _made_scenes(text):
    def make(folder):
        for points in (12, 7):
            made = reconstruction()
            for number in list(made.points3D)[points:]:
                made.delete_point3D(number)
            for extra in (True, False):  # the rigs and frames of newer versions, or none
                seed = write_scene(folder / f"{points}-{extra}", made, text)
                if not extra:
                    for path in (seed / "sparse/0").glob("*"):
                        if path.stem in ("rigs", "frames"):
                            path.unlink()
                yield seed

    return make


def _scene(folder):
    usable(read_scene(folder))


def _made_plys(folder):
    for seed, (count, degree, sphere) in numbered(folder, ((5, 0, True), (3, 1, False), (2, 3, False))):
        write_ply(seed / "model.ply", gaussians_like(count, degree), (1.5, 2.0, 3e6), ("made",), sphere)
        yield seed
    head, _, _ = (folder / "0/model.ply").read_bytes().partition(b"end_header\n")
    rows = b"".join(b" ".join([b"0.25"] * head.count(b"property")) + b"\n" for _ in range(5))
    seed = folder / "text"
    seed.mkdir()
    (seed / "model.ply").write_bytes(head.replace(b"binary_little_endian", b"ascii") + b"end_header\n" + rows)
    yield seed


def _ply(folder):
    check(read_ply(folder / "model.ply"))


def _made_transforms(folder):
    scene = read_scene(write_scene(folder / "made"))
    whole, angled, parted = (folder / kind for kind in ("whole", "angled", "parted"))
    for seed in (whole, angled, parted):
        table = layouts.write_transforms(seed, scene)
    (angled / "sparse_pc.ply").unlink()  # points are drawn, and suffixes tried
    layouts.write_json(
        angled / "transforms.json",
        {
            **layouts.camera_angle(scene),
            "frames": [{**frame, "file_path": frame["file_path"][:-4]} for frame in table["frames"]],
        },
    )
    for number, part in enumerate(("train", "test")):
        layouts.write_json(parted / f"transforms_{part}.json", {**table, "frames": table["frames"][number::2]})
    return whole, angled, parted


def _made_options(folder):
    for seed, lines in numbered(
        folder,
        (
            (
                "iterations = 500",
                "downscale = 2.5",
                "levels = [4.0, 2.0, 1.0]",
                "size = 'L'",
                "background = [0.0, 0.5, 1.0]",
                "sphere = false",
                'preset = "paper"',
            ),
            (
                "# a comment",
                "time-budget = '10m'",
                "schedule = 'dash'",
                "seed = 3",
                "init = 'sfm'",
                "levels = [8.0, 4.0, 1.0]",
                "antialiased = true",
                "grow-threshold = 1e-4",
            ),
        ),
    ):
        (seed / "run.toml").write_text("\n".join(lines) + "\n")
        yield seed


def _options(folder):
    options = resolve(from_toml(folder / "run.toml"), {})
    assert 0 <= options.sh_degree <= 3


DJI = {
    "GimbalYawDegree": "+12.50",
    "GimbalPitchDegree": "-89.90",
    "GimbalRollDegree": "+0.00",
    "RelativeAltitude": "+60.1",
    "RtkStdLon": "0.01",
    "RtkStdLat": "0.01",
    "RtkStdHgt": "0.02",
    "CalibratedFocalLength": "3666.0",
    "DewarpData": "2020-01-01;3.6,3.6,1,1,0,0,0,0,0",
}
EXIF = {
    **GPS,
    "Exif:FocalLength": 8.8,
    "Exif:FocalLengthIn35mmFilm": 24,
    "Make": "DJI",
    "Model": "FC6310",
    "DateTime": "2020:01:02 03:04:05",
    "Orientation": 6,
}


def _metadata(folder):
    for seed, (exif, xmp) in numbered(folder, ((EXIF, DJI), (EXIF, None), ({}, DJI))):
        photo(seed / "photo.jpg", exif, xmp, size=(24, 16))
        yield seed


def _read_metadata(folder):
    data = read_metadata(folder / "photo.jpg")
    finite(data.latitude, data.longitude, data.altitude, data.gps_std, data.focal_pixels, data.gimbal_pitch)
    assert data.width > 0 and data.height > 0
    assert data.latitude is None or abs(data.latitude) <= 90


def _georeferences(folder):
    view = Camera.looking_at((0, 0, 0), (1, 2, 3))
    for seed, (crs, looking) in numbered(folder, ((PLACE.crs, None), ('PROJCRS["made"]', view))):
        write_georeference(seed, replace(PLACE, crs=crs))
        write_orientation(seed, (0.0, 0.6, 0.8), looking)
        yield seed


def _georeference(folder):
    place, orientation = read_georeference(folder), places.read_orientation(folder)
    if place is not None:
        finite(place.offset, place.residual)
    if orientation is not None:
        up, view = orientation
        assert np.linalg.norm(up) > 0.99
        if view is not None:
            finite(view.position, view.focal, view.centre)


def _control_points(folder):
    for seed, lines in numbered(
        folder,
        (
            (
                "EPSG:32632",
                "500010.5 5300020 210 100 200 a.jpg one",
                "500010.5 5300020 210 120 190 b.jpg one",
                "500050 5300090 212 10 20 a.jpg two",
            ),
            (
                "EPSG:4326",
                "name,x,y,z,pixel_x,pixel_y,image",
                "one,9.0,47.8,210,100,200,a.jpg",
                "two,9.001,47.801,212,10,20,a.jpg",
            ),
        ),
    ):
        (seed / "gcp.txt").write_text("\n".join(lines) + "\n")
        yield seed


def _read_control_points(folder):
    read = read_control_points(folder / "gcp.txt")
    assert read.crs and read.points
    for point in read.points:
        finite(point.position, *(mark[1:] for mark in point.marks))


def _measured(folder):
    """A surface, and lines and polygons on it."""
    for seed, degrees in numbered(folder, (False, True)):
        surfaces.write_surface(seed / "surface.tif", surfaces.heap(*surfaces.places(1.0, 40)), pixel=1.0)
        shapes = [
            surfaces.feature("LineString", surfaces.square(8), "line"),
            surfaces.feature("MultiPolygon", [[surfaces.square(9), surfaces.square(2)]], "heap"),
        ]
        if degrees:
            shapes = [
                surfaces.feature(
                    "Polygon", [[[13.5614, 51.442], [13.5617, 51.442], [13.5617, 51.4422], [13.5614, 51.442]]]
                )
            ]
        surfaces.write_features(seed / "shapes.json", *shapes)
        yield seed


def _measure(folder):
    measure(folder / "surface.tif", read_features(folder / "shapes.json", surfaces.CRS))


PROJECT_LENS = (40.0, 40.0, 23.0, 19.0, -0.1, 0.02, 1e-3, -2e-3, 0.01, 0.0, 0.0, 0.0)
ON_EARTH = (1.0, np.eye(3), np.array([4.1e6, 6.3e5, 4.8e6]))  # geocentric, metres


def _scenes(folder):
    """A scene of a pinhole camera and one with a lens, with few points."""
    for model, parameters in (("PINHOLE", PROJECT_LENS[:4]), ("FULL_OPENCV", PROJECT_LENS)):
        made = reconstruction(model, parameters)
        for number in list(made.points3D)[12:]:
            made.delete_point3D(number)
        yield folder / f"town_{model}", read_scene(write_scene(folder / model, made))


def _opensfm(folder):
    for reference, (seed, scene) in zip((None, (52.4, 16.9, 80.0)), _scenes(folder)):
        projects.write_opensfm(seed, scene, reference)
        yield seed


def _metashape(folder):
    for reference, (seed, scene) in zip(("", "EPSG:4326"), _scenes(folder)):
        seed.mkdir()
        projects.write_metashape(seed, scene, reference=reference)
        if reference:
            path = seed / "cameras.xml"
            place = projects.texts(ON_EARTH[2])
            path.write_text(path.read_text().replace("<translation>0.0 0.0 0.0", f"<translation>{place}"))
        else:
            layouts.write_ply(seed / "points3D.ply", scene.points, scene.colours)
        yield seed


READERS = {
    "colmap": Reader(_made_scenes(False), _scene, files=(".bin",)),
    "colmap-text": Reader(_made_scenes(True), _scene, text=True, files=(".txt",)),
    "transforms": Reader(_made_transforms, _scene, text=True, files=(".json", ".ply")),
    "opensfm": Reader(_opensfm, _scene, text=True, files=(".json", ".csv")),
    "metashape": Reader(_metashape, _scene, text=True, files=(".xml",)),
    "image": Reader(made_images, read_pixels),
    "profile": Reader(made_with_profiles, read_pixels),
    "heic": Reader(made_decoded(write_heic, "a.heic", *HEICS), decoded("a.heic")),
    "raw": Reader(made_decoded(write_dng, "a.dng", *DNGS), decoded("a.dng")),
    "metadata": Reader(_metadata, _read_metadata, files=(".jpg",)),
    "ply": Reader(_made_plys, _ply, files=(".ply",)),
    **{suffix[1:]: _model(suffix) for suffix in (".spz", ".sog", ".glb", ".las")},  # lazrs aborts on bad LAZ
    "spz4": _model(".spz", 4),
    "geojson": Reader(_measured, _measure, text=True, files=(".json",)),
    "surface": Reader(_measured, _measure, files=(".tif",)),
    "georeference": Reader(_georeferences, _georeference, text=True, files=(".json",)),
    "gcp": Reader(_control_points, _read_control_points, text=True, files=(".txt",)),
    "options": Reader(_made_options, _options, text=True),
}
