"""Projects in Pix4D's Open Photogrammetry Format are read as they were written."""

import json

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.io.scenes.projects.opf import rotation_of
from clsplat.io.scenes.read import read_scene
from tests.data.layouts import assert_same
from tests.data.projects import write_opf
from tests.data.tiny_model import reconstruction, write_scene

LENS = (40.0, 40.0, 23.0, 19.0, -0.1, 0.02, 1e-3, -2e-3, 0.01, 0.0, 0.0, 0.0)
MODELS = {"PINHOLE": (40.0, 40.0, 23.0, 19.0), "FULL_OPENCV": LENS}
LOCAL = 'ENGCRS["Site",EDATUM["Corner"],CS[Cartesian,3]]'


def made(folder, model="PINHOLE"):
    return read_scene(write_scene(folder / "made", reconstruction(model, MODELS[model])))


@pytest.mark.parametrize("model", MODELS)
def test_a_project(tmp_path, model):
    """Positions in glTF are float32, those of cameras are not."""
    scene = made(tmp_path, model)
    write_opf(tmp_path, scene, LOCAL)
    read = read_scene(tmp_path)
    assert_same(read, scene, points=1e-6)
    assert read.georeference is None and read.up[2] == 1
    assert_same(read_scene(tmp_path / "project.opf"), scene, points=1e-6)


def test_rotations_are_those_of_the_specification():
    """R_x(omega) R_y(phi) R_z(kappa), camera axes right, up, back, written out by hand."""
    (so, sp, sk), (co, cp, ck) = (f(np.radians((20.0, -35.0, 130.0))) for f in (np.sin, np.cos))
    rx = np.array([(1, 0, 0), (0, co, -so), (0, so, co)])
    ry = np.array([(cp, 0, sp), (0, 1, 0), (-sp, 0, cp)])
    rz = np.array([(ck, -sk, 0), (sk, ck, 0), (0, 0, 1)])
    np.testing.assert_allclose(rotation_of(np.array([20.0, -35.0, 130.0])),
                               rx @ ry @ rz @ np.diag([1, -1, -1]), atol=1e-12)


def test_georeference(tmp_path):
    scene = made(tmp_path)
    write_opf(tmp_path, scene, "EPSG:32632+EPSG:5773")
    read = read_scene(tmp_path)
    assert read.georeference.crs == "EPSG:32632"
    assert read.georeference.offset == (500000.0, 5300000.0, 200.0)
    assert_same(read, scene, points=1e-6)
    write_opf(tmp_path, scene, "EPSG:2263")  # feet
    read = read_scene(tmp_path)
    assert read.georeference is None and any("in metres" in note for note in read.notes)


def changed(folder, name, change):
    path = folder / name
    table = json.loads(path.read_text())
    change(table)
    path.write_text(json.dumps(table))


@pytest.mark.parametrize("name, change, words", [
    ("calibrated-cameras.json", lambda t: t["cameras"][0].update(sensor_id=8), "sensor 8"),
    ("calibrated-cameras.json", lambda t: t["sensors"][0]["internals"].update(type="fisheye"),
     "type fisheye are not read"),
    ("camera-list.json", lambda t: t["cameras"].pop(0), "has no photo"),
    ("camera-list.json", lambda t: t["cameras"][0].update(uri="https://a/b.jpg"), "not a file"),
    ("project.opf", lambda t: t["items"].pop(2), "calibrate the project"),
    ("tracks/tracks.gltf", lambda t: t["accessors"][0].update(count=10**9), "claim to hold"),
    ("tracks/tracks.gltf", lambda t: t["buffers"][0].update(uri="none.bin"), "none.bin: no such"),
])
def test_what_is_refused(tmp_path, name, change, words):
    write_opf(tmp_path, made(tmp_path), LOCAL)
    changed(tmp_path, name, change)
    with pytest.raises(InputError, match=words) as caught:
        read_scene(tmp_path)
    assert "project.opf" in str(caught.value) or "none.bin" in words
    assert "\n" not in str(caught.value)


def test_other_ways_to_name_photos(tmp_path):
    """URIs with escapes."""
    scene = made(tmp_path)
    write_opf(tmp_path, scene, LOCAL)
    (tmp_path / "images/photo_0.png").rename(tmp_path / "images/a b.png")

    def change(table):
        for camera in table["cameras"]:
            camera["uri"] = camera["uri"].replace("photo_0", "a%20b")
    changed(tmp_path, "camera-list.json", change)
    read = read_scene(tmp_path)
    assert sorted(view.name for view in read.views)[0] == "a b.png"


@pytest.mark.parametrize("version, is_read", [
    ("1.7", True), (1.0, True), ("0.9-draft4", False), (None, False), ("2.0", False), ([], False)])
def test_other_versions_are_named(tmp_path, version, is_read):
    write_opf(tmp_path, made(tmp_path))
    path = tmp_path / "calibrated-cameras.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "version": version}))
    if is_read:
        assert len(read_scene(tmp_path).views) == 4
        return
    with pytest.raises(InputError, match="calibrated-cameras.json: version .* of OPF is not read"):
        read_scene(tmp_path)
