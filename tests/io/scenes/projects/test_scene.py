"""Photos are found by the names that projects have for them; scenes lie where pyproj says."""

import numpy as np
import pyproj
import pytest

from clsplat.errors import InputError
from clsplat.io.scenes.projects.scene import PhotoFiles, on_map, topocentric
from clsplat.placement.alignment import Similarity


@pytest.fixture
def project(tmp_path):
    for name in ("images/1/a.JPG", "images/2/a.JPG", "images/2/b.tif", "images/c.xmp"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    return tmp_path


@pytest.mark.parametrize(
    "name, found",
    [
        ("2/b.tif", "2/b.tif"),
        ("b", "2/b.tif"),
        ("B.TIF", "2/b.tif"),
        ("E:\\x\\2\\b.tif", "2/b.tif"),
        ("c:/flight/2/a.JPG", "2/a.JPG"),
        ("/mnt/1/a", "1/a.JPG"),
        ("other/b.tif", "2/b.tif"),
    ],
)
def test_a_photo_is_found(project, name, found):
    assert PhotoFiles(project).find(name) == (found, project / "images" / found)


def test_two_photos_that_fit_equally(project):
    with pytest.raises(InputError, match="several photos fit 'a.JPG'.*--images"):
        PhotoFiles(project).find("a.JPG")
    assert PhotoFiles(project, "images/1").find("a.JPG") == ("a.JPG", project / "images/1/a.JPG")


@pytest.mark.parametrize("other", ["3/1/a.JPG", "1/A.jpg", "1/a.JPG.png"])
def test_the_very_name_decides(project, other):
    """Beside a copy of the folder, a name in other letters, and a mask."""
    (project / "images" / other).parent.mkdir(parents=True, exist_ok=True)
    (project / "images" / other).touch()
    assert PhotoFiles(project).find("1/a.JPG") == ("1/a.JPG", project / "images/1/a.JPG")


def test_photos_in_a_folder_that_is_a_link(project):
    (project / "other").mkdir()
    (project / "other/a.JPG").touch()
    (project / "images/3").symlink_to(project / "other")
    assert PhotoFiles(project).find("3/a.JPG") == ("3/a.JPG", project / "images/3/a.JPG")


def test_a_photo_beside_the_project(tmp_path):
    (tmp_path / "a.jpg").touch()
    assert PhotoFiles(tmp_path).find("a.jpg") == ("a.jpg", tmp_path / "a.jpg")


def test_photos_of_one_name_outside_of_the_project(tmp_path):
    """Of two flights of a drone, which names photos by number."""
    for flight in ("1", "2"):
        (tmp_path / "flights" / flight).mkdir(parents=True)
        (tmp_path / "flights" / flight / "a.jpg").touch()
    (tmp_path / "project").mkdir()
    files = PhotoFiles(tmp_path / "project")
    for flight in ("1", "2"):
        name, path = files.find(f"../flights/{flight}/a.jpg")
        assert name == f"flights/{flight}/a.jpg" and path.resolve() == tmp_path / name


def test_missing_photos(project):
    name, path = PhotoFiles(project).find("images/d.jpg")
    assert (name, path) == ("d.jpg", project / "images/d.jpg")
    with pytest.raises(InputError, match=r"d.jpg: no such image \(1 of 2 .*--images"):
        PhotoFiles(project).found(["images/d.jpg", "b"])


@pytest.mark.parametrize("name", [None, 3, "", "a\nb", "/", ".."])
def test_names_that_are_none(project, name):
    with pytest.raises(ValueError):
        PhotoFiles(project).find(name)


def test_a_kilometre_of_cameras():
    """East of the zone's middle: what is left is the earth's curvature, centimetres."""
    random = np.random.default_rng(0)
    earth = topocentric(52.4, 17.9, 80.0)
    centres = random.uniform((-500, -500, 50), (500, 500, 150), (100, 3))
    similarity, georeference = on_map(earth, centres, "", "made")
    assert georeference.crs == "EPSG:32633" and georeference.offset[0] % 1 == 0
    exact = np.stack(
        pyproj.Transformer.from_crs("EPSG:4978", "EPSG:32633", always_xy=True).transform(*earth(centres).T), axis=1
    )
    places = georeference.to_map(similarity(centres))
    missed = np.linalg.norm(places - exact, axis=1)
    assert missed.max() < 0.1
    assert georeference.residual == pytest.approx(np.sqrt((missed**2).mean()))
    assert 0.9995 < similarity.scale < 1.0005
    assert np.abs(similarity(centres)).max() < 1500  # small numbers, the rest is the offset


def test_a_reconstruction_in_any_unit_and_frame():
    """The same cameras in other coordinates come to the same places."""
    random = np.random.default_rng(1)
    earth = topocentric(52.4, 17.9, 80.0)
    axes, place = earth.rotation, earth.translation
    centres = random.uniform(-100, 100, (20, 3))
    places, reference = on_map(earth, centres, "", "made")
    # any rotation, a large shift, 40 units a metre
    turn, shift = axes.T, np.array([3e4, -2e4, 1e4])
    other = 40 * centres @ turn.T + shift
    similarity, georeference = on_map(
        Similarity(1 / 40, axes @ turn.T, place - axes @ turn.T @ shift / 40), other, "", "made"
    )
    np.testing.assert_allclose(georeference.to_map(similarity(other)), reference.to_map(places(centres)), atol=5e-3)


def test_a_map_that_mirrors():
    """Its axes point to the south and to the west, in this order."""
    with pytest.raises(ValueError, match="mirrored"):
        on_map(topocentric(49.8, 15.5, 300.0), 50 * np.eye(3), "EPSG:5513", "made")


def test_cameras_that_are_not_on_the_earth():
    with pytest.raises(ValueError, match="earth's surface"):
        on_map(Similarity(1.0, np.eye(3), np.zeros(3)), np.ones((2, 3)), "", "made")
