"""Registrations of RealityScan are read as they were written."""

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.io.scenes.projects.realityscan import _csv_optics, _xmp_optics, rotation_of
from clsplat.io.scenes.read import read_scene
from tests.data.formulas import colmap, rays, realityscan
from tests.data.layouts import world_points, write_ply
from tests.data.projects import assert_same, write_realityscan
from tests.data.tiny_model import reconstruction, write_scene

LENS = (40.0, 40.0, 23.0, 19.0, -0.1, 0.02, 1e-3, -2e-3, 0.01, 0.0, 0.0, 0.0)
MODELS = {"PINHOLE": (40.0, 40.0, 23.0, 19.0), "FULL_OPENCV": LENS, "OPENCV": LENS[:8]}


def made(folder, model="PINHOLE"):
    return read_scene(write_scene(folder / "made", reconstruction(model, MODELS[model])))


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("form", ["angles", "matrices", "xmp"])
def test_a_registration(tmp_path, model, form):
    scene = made(tmp_path, model)
    write_realityscan(tmp_path, scene, form)
    write_ply(tmp_path / "points3D.ply", world_points(scene), scene.colours)
    assert_same(read_scene(tmp_path), scene)
    if form != "xmp":
        assert_same(read_scene(tmp_path / "registration.csv"), scene)


def test_angles_are_those_of_other_readers():
    """nerfstudio turns by -heading about z, pitch about x and roll about y, with camera axes right,
    up and back."""
    from scipy.spatial.transform import Rotation

    yaw, pitch, roll = 130.0, 35.0, -12.0
    theirs = Rotation.from_euler("ZXY", (-yaw, pitch, roll), degrees=True).as_matrix()
    np.testing.assert_allclose(rotation_of(yaw, pitch, roll), theirs * (1, -1, -1), atol=1e-12)
    # level, a camera looks down with its top to the north
    np.testing.assert_allclose(rotation_of(0, 0, 0), [(1, 0, 0), (0, -1, 0), (0, 0, -1)],
                               atol=1e-12)


@pytest.mark.parametrize("model, values", [
    ("perspective", (0.1, 0, 0, 0, 0, 0)), ("division", (0.12, 0, 0, 0, 0, 0)),
    ("brown3", (-0.1, 0.02, 0.01, 0, 0, 0)), ("brown3t2", (-0.1, 0.02, 0.01, 0, 2e-3, -3e-3)),
    ("brown4t2", (-0.1, 0.02, 0.01, 0, 2e-3, -3e-3))])
def test_camera_models_are_those_of_the_paper(model, values):
    row = {"FocalLength35mm": "30.5", "PrincipalPointU": "0.01", "PrincipalPointV": "-0.02",
           "DistortionModel": model, "DistortionCoeficients": " ".join(map(str, values))}
    used = np.zeros(6) if model == "perspective" else values
    wanted = realityscan(rays(), (640, 480), 30.5, 0.01, -0.02, model, used)
    np.testing.assert_allclose(colmap(_xmp_optics(row, (640, 480)), rays()), wanted, atol=1e-9)
    if model.startswith("brown"):
        row = {"f_35mm": "30.5", "px_norm": "0.01", "py_norm": "-0.02", **dict(
            zip(("k1", "k2", "k3", "k4", "t1", "t2"), map(str, values)))}
        np.testing.assert_allclose(colmap(_csv_optics(row, (640, 480)), rays()), wanted, atol=1e-9)


def test_a_table_of_other_columns(tmp_path):
    """Its columns may be chosen: distortion is none, and the principal point in the middle."""
    scene = made(tmp_path)
    write_realityscan(tmp_path, scene)
    path = tmp_path / "registration.csv"
    kept = [",".join(line.split(",")[:8]) for line in path.read_text().splitlines()]
    path.write_text("\ufeff" + "\n".join(kept))
    read = read_scene(tmp_path)
    assert read.views[0].lens is None and read.views[0].camera.centre == (24.0, 18.0)
    assert read.views[0].camera.focal[0] == pytest.approx(40.0)


@pytest.mark.parametrize("old, new, words", [
    ("brown3t2", "rationalP2D1", "rationalP2D1 is not read"),
    ('Skew="0"', 'Skew="0.1"', "not square"),
    ('Coordinates="absolute"', 'Coordinates="relative"', "relative to a rig")])
def test_xmp_that_is_refused(tmp_path, old, new, words):
    write_realityscan(tmp_path, made(tmp_path, "FULL_OPENCV"), "xmp")
    path = tmp_path / "images/photo_1.xmp"
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(InputError, match=words) as caught:
        read_scene(tmp_path)
    assert "photo_1" in str(caught.value)


def test_four_radial_coefficients(tmp_path):
    write_realityscan(tmp_path, made(tmp_path))
    path = tmp_path / "registration.csv"
    lines = path.read_text().splitlines()
    cells = lines[3].split(",")
    cells[13] = "0.01"
    path.write_text("\n".join([*lines[:3], ",".join(cells), *lines[4:]]))
    lens, = {view.lens for view in read_scene(tmp_path).views if view.lens}
    assert lens.model == "BROWN_K4" and lens.parameters[7] == 0.01


def test_other_files_are_none(tmp_path):
    """A folder with sidecars of a raw converter, or another table, is no registration."""
    scene = made(tmp_path)
    write_realityscan(tmp_path, scene)
    (tmp_path / "registration.csv").write_text("name,time\nphoto_1.png,3\n")
    (tmp_path / "images/photo_1.xmp").write_text("<x:xmpmeta xmlns:x='adobe:ns:meta/'/>")
    with pytest.raises(InputError, match="no COLMAP model"):
        read_scene(tmp_path)
