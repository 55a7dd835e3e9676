"""Cameras that Metashape exports are read as they were written."""

import re

import numpy as np
import pyproj
import pytest
from scipy.spatial.transform import Rotation

from clsplat.errors import InputError
from clsplat.io.scenes.projects.scene import topocentric
from clsplat.io.scenes.read import read_scene
from tests.data.formulas import colmap, metashape, rays
from tests.data.layouts import assert_same, world_points, write_ply
from tests.data.projects import texts, write_metashape
from tests.data.tiny_model import reconstruction, write_scene
from tests.refusals import refused

LENS = (40.0, 40.5, 23.0, 19.0, -0.1, 0.02, 1e-3, -2e-3, 0.01, 0.0, 0.0, 0.0)
FISHEYE = (40.0, 40.5, 23.0, 19.0, -0.1, 0.02, 1e-3, -2e-3, 0.01, -0.003, 0.0, 0.0)
MODELS = {"PINHOLE": None, "FULL_OPENCV": LENS, "OPENCV": LENS[:8], "THIN_PRISM_FISHEYE": FISHEYE}
GEOGRAPHIC = (
    'GEOGCS["WGS 84",DATUM["World Geodetic System 1984",SPHEROID["WGS 84",6378137,'
    '298.257223563]],PRIMEM["Greenwich",0],UNIT["degree",0.01745329251994328],'
    'AUTHORITY["EPSG","4326"]]'
)
TRANSFORM = 2.5, Rotation.from_rotvec([0.3, -0.2, 1.0]).as_matrix(), np.array([10.0, -20.0, 5.0])


def made(folder, model="PINHOLE"):
    parameters = MODELS[model]
    return read_scene(
        write_scene(folder / "made", reconstruction(model, parameters) if parameters else reconstruction())
    )


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("component", [True, False])
def test_exported_cameras(tmp_path, model, component):
    """The points are beside them; the transform is the component's, or the chunk's."""
    scene = made(tmp_path, model)
    path = write_metashape(tmp_path, scene, TRANSFORM, component=component)
    write_ply(tmp_path / "points3D.ply", world_points(scene), scene.colours)
    assert_same(read_scene(tmp_path), scene)
    assert_same(read_scene(path), scene)


@pytest.mark.parametrize("kind", ["frame", "fisheye"])
def test_camera_models_are_those_of_the_manual(tmp_path, kind):
    from xml.etree import ElementTree

    from clsplat.io.scenes.projects.metashape import _optics

    values = {
        "f": 500.0,
        "cx": 3.0,
        "cy": -2.0,
        "b1": 4.0,
        "k1": -0.1,
        "k2": 0.02,
        "k3": 0.01,
        "p1": 2e-3,
        "p2": -3e-3,
        **({"k4": -0.004} if kind == "fisheye" else {}),
    }
    sensor = ElementTree.fromstring(
        f'<sensor type="{kind}"><resolution width="640" height="480"/><calibration>'
        + "".join(f"<{key}>{value}</{key}>" for key, value in values.items())
        + "</calibration></sensor>"
    )
    k = [values.pop(f"k{n}", 0.0) for n in range(1, 5)]
    wanted = metashape(rays(), (640, 480), k=k, wide=kind == "fisheye", **values)
    np.testing.assert_allclose(colmap(_optics(sensor), rays()), wanted, atol=1e-9)


def test_points_are_sampled_without_a_file(tmp_path, caplog):
    write_metashape(tmp_path, made(tmp_path))
    assert len(read_scene(tmp_path).points) > 100
    assert "sampled at random" in caplog.text and "points3D.ply" in caplog.text


def test_cameras_that_are_not_aligned(tmp_path):
    path = write_metashape(tmp_path, made(tmp_path))
    text = re.sub(r"<transform>[^<]*</transform>", "", path.read_text(), count=1)
    path.write_text(text.replace('<camera id="1"', '<camera enabled="false" id="1"'))
    read = read_scene(tmp_path)
    assert len(read.views) == 2
    assert any("2 of 4 photos" in note for note in read.notes)


def on_earth(folder, scene, reference):
    """Write the scene as one that lies east, north and up of a place; the way to the earth."""
    earth = topocentric(52.4, 16.9, 80.0)
    path = write_metashape(folder, scene, reference=reference)
    placed = (
        f"<transform><rotation>{texts(earth.rotation)}</rotation><translation>"
        f"{texts(earth.translation)}</translation></transform></component>"
    )
    path.write_text(re.sub(r"<transform><rotation.*?</component>", placed, path.read_text()))
    return earth


@pytest.mark.parametrize(
    "reference, crs",
    [
        (GEOGRAPHIC, "EPSG:32633"),
        ("EPSG:25833", "EPSG:25833"),
        ("EPSG:2180", "EPSG:2180"),  # Poland's, with the north first
        ("EPSG:2263", "EPSG:32633"),
    ],
)  # in feet
def test_georeference(tmp_path, reference, crs):
    """Geocentric coordinates become those of the chunk's map, or of the UTM zone if the map is not
    in metres."""
    scene = made(tmp_path)
    earth = on_earth(tmp_path, scene, reference)
    read = read_scene(tmp_path)
    assert read.georeference.crs == crs
    to_map = pyproj.Transformer.from_crs("EPSG:4978", crs, always_xy=True)
    for view, other in zip(read.views, scene.views):
        place = earth(other.camera.position + scene.offset)
        np.testing.assert_allclose(
            read.georeference.to_map(view.camera.position + read.offset), to_map.transform(*place), atol=1e-3
        )
    assert read.georeference.residual < 1e-3 and read.up[2] == 1


def test_points_of_a_map(tmp_path):
    """A point cloud in map coordinates is brought to the scene's."""
    on_earth(tmp_path, made(tmp_path), "EPSG:4326")
    read = read_scene(tmp_path)
    write_ply(tmp_path / "points3D.ply", read.georeference.to_map(world_points(read)))
    again = read_scene(tmp_path)
    np.testing.assert_allclose(world_points(again), world_points(read), atol=1e-6)


@pytest.mark.parametrize("extra, words", [("<p4>0.01</p4>", "p4"), ("<b2>-0.3</b2>", "b2"), ("<p3>1e-5</p3>", "p3")])
def test_coefficients_that_colmap_has_not(tmp_path, extra, words):
    write_metashape(tmp_path, made(tmp_path), extra=extra)
    refused(lambda: read_scene(tmp_path), "cameras.xml", f"coefficient {words}; optimise")


def test_entities_are_refused(tmp_path):
    path = write_metashape(tmp_path, made(tmp_path))
    entities = "".join(f'<!ENTITY e{n + 1} "{f"&e{n};" * 20}">' for n in range(8))
    text = path.read_text().replace("<chunk", "&e8;<chunk", 1)
    bomb = f'<!DOCTYPE d [<!ENTITY e0 "a">{entities}]>'
    path.write_text(text.replace("<document", bomb + "<document", 1))
    with pytest.raises(InputError, match="limit on input amplification"):
        read_scene(path)
