"""Reconstructions of OpenSfM and ODM give the cameras that were written."""

import json

import numpy as np
import pyproj
import pytest

from clsplat.io.scenes.projects.opensfm import _optics
from clsplat.io.scenes.read import read_scene
from tests.data.formulas import colmap, opensfm, rays
from tests.data.layouts import assert_same
from tests.data.projects import write_opensfm
from tests.data.tiny_model import reconstruction, write_scene
from tests.refusals import refused

LENS = "FULL_OPENCV", (40.0, 40.5, 23.0, 19.0, -0.1, 0.02, 1e-3, -2e-3, 0.01, 0.0, 0.0, 0.0)
CAMERAS = {
    "perspective": {"focal": 0.9, "k1": -0.1, "k2": 0.03},
    "brown": {
        "focal_x": 0.9,
        "focal_y": 0.8,
        "c_x": 0.01,
        "c_y": -0.02,
        "k1": -0.1,
        "k2": 0.03,
        "p1": 2e-3,
        "p2": -3e-3,
        "k3": 0.01,
    },
    "fisheye": {"focal": 0.9, "k1": -0.1, "k2": 0.03},
    "fisheye_opencv": {
        "focal_x": 0.9,
        "focal_y": 0.8,
        "c_x": 0.01,
        "c_y": -0.02,
        "k1": -0.1,
        "k2": 0.03,
        "k3": 0.01,
        "k4": -0.02,
    },
}


@pytest.fixture(scope="module", params=["PINHOLE", LENS[0]])
def scene(request, tmp_path_factory):
    made = reconstruction(*LENS) if request.param == LENS[0] else reconstruction()
    return read_scene(write_scene(tmp_path_factory.mktemp("colmap") / "town", made))


def test_a_reconstruction(tmp_path, scene):
    write_opensfm(tmp_path, scene)
    read = read_scene(tmp_path)
    assert_same(read, scene)
    assert np.array_equal(read.observations, scene.observations)
    assert read.georeference is None and np.array_equal(read.up, (0, 0, 1))
    assert_same(read_scene(tmp_path / "reconstruction.json"), scene)


@pytest.mark.parametrize("kind", CAMERAS)
def test_camera_models_are_those_of_the_documentation(kind):
    camera = {"projection_type": kind, "width": 640, "height": 480, **CAMERAS[kind]}
    optics = _optics(camera, (640, 480))
    np.testing.assert_allclose(colmap(optics, rays()), opensfm(rays(), camera), atol=1e-9)


def test_normalised_coordinates_suit_photos_of_any_size(tmp_path, scene):
    """ODM writes cameras in the size of which it took features."""
    table = write_opensfm(tmp_path, scene)
    for camera in table["cameras"].values():
        camera["width"], camera["height"] = camera["width"] // 4, camera["height"] // 4
    (tmp_path / "reconstruction.json").write_text(json.dumps([table]))
    assert_same(read_scene(tmp_path), scene)


def test_a_folder_of_odm(tmp_path, scene):
    """OpenSfM's own result is preferred to what ODM moved onto its map."""
    write_opensfm(tmp_path / "opensfm", scene)
    (tmp_path / "opensfm/images").rename(tmp_path / "images")
    path = tmp_path / "opensfm/reconstruction.json"
    path.rename(path.with_name("reconstruction.topocentric.json"))
    path.write_text("[]")
    assert_same(read_scene(tmp_path), scene)


def test_the_largest_part(tmp_path, scene):
    table = write_opensfm(tmp_path, scene)
    small = {**table, "shots": dict(list(table["shots"].items())[:1])}
    (tmp_path / "reconstruction.json").write_text(json.dumps([small, table]))
    read = read_scene(tmp_path)
    assert_same(read, scene)
    assert any("4 of 5 photos" in note for note in read.notes)


def test_georeference(tmp_path, scene):
    """A metre east, north and up of the reference is one on the map, and offsets add up to it."""
    reference = 52.4, 16.9, 80.0
    write_opensfm(tmp_path, scene, reference)
    read = read_scene(tmp_path)
    assert read.georeference.crs == "EPSG:32633" and read.georeference.residual < 1e-3
    assert "4 photos" in read.georeference.source
    to_map = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:32633", always_xy=True)
    east, north, height = to_map.transform(reference[1], reference[0], reference[2])
    for view, other in zip(read.views, scene.views):
        place = read.georeference.to_map(view.camera.position + read.offset)
        wanted = (east, north, height) + other.camera.position + scene.offset
        # the grid's scale, and its north, which is half a degree away
        np.testing.assert_allclose(place, wanted, atol=0.3)
        # photos show the same as before
        np.testing.assert_allclose(
            view.camera.project(read.points)[0], other.camera.project(scene.points)[0], atol=1e-6
        )
    distances = [np.linalg.norm(s.views[0].camera.position - s.views[1].camera.position) for s in (read, scene)]
    assert distances[0] / distances[1] == pytest.approx(1, abs=5e-4) and read.up[2] == 1


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda table: table.update(cameras={}), "the camera of shot .* is not an object"),
        (lambda table: table["shots"]["photo_0.png"].update(rotation=[0, 0]), "not 3 numbers"),
        (lambda table: table["cameras"]["v2 made"].update(projection_type="dual"), "dual is not read"),
        (lambda table: table.update(shots={}), "align the photos first"),
        (lambda table: table.update(shots={"a.jpg": {}}), "1 of 1 photos of the project are missing"),
    ],
)
def test_what_is_refused(tmp_path, scene, change, words):
    table = write_opensfm(tmp_path, scene)
    change(table)
    (tmp_path / "reconstruction.json").write_text(json.dumps([table]))
    refused(lambda: read_scene(tmp_path), str(tmp_path), *words.split(" .* "))


@pytest.mark.parametrize("kind, key", [("brown", "k4"), ("fisheye", "p2")])
def test_coefficients_that_no_model_has(kind, key):
    camera = {"projection_type": kind, "width": 640, "height": 480, **CAMERAS[kind], key: 0.01}
    with pytest.raises(ValueError, match=f"its coefficient {key}"):
        _optics(camera, (640, 480))
