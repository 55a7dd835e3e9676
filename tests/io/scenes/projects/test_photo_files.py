"""Photos are found by the names that projects have for them."""

import pytest

from clsplat.errors import InputError
from clsplat.io.scenes.projects.scene import PhotoFiles


@pytest.fixture
def project(tmp_path):
    for name in ("images/1/a.JPG", "images/2/a.JPG", "images/2/b.tif", "images/c.xmp"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    return tmp_path


@pytest.mark.parametrize("name, found", [
    ("2/b.tif", "2/b.tif"), ("b", "2/b.tif"), ("B.TIF", "2/b.tif"), ("E:\\x\\2\\b.tif", "2/b.tif"),
    ("file:///c:/flight/2/a.JPG", "2/a.JPG"), ("/mnt/1/a", "1/a.JPG"), ("other/b.tif", "2/b.tif")])
def test_a_photo_is_found(project, name, found):
    assert PhotoFiles(project).find(name) == (found, project / "images" / found)


def test_two_photos_that_fit_equally(project):
    with pytest.raises(InputError, match="several photos fit 'a.JPG'.*--images"):
        PhotoFiles(project).find("a.JPG")
    assert PhotoFiles(project, "images/1").find("a.JPG") == ("a.JPG", project / "images/1/a.JPG")


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
    for flight, name in (("1", "a.jpg"), ("2", "2/a.jpg"), ("1", "a.jpg")):
        found, path = files.find(f"../flights/{flight}/a.jpg", tmp_path / "project")
        assert found == name and path.resolve() == tmp_path / "flights" / flight / "a.jpg"


def test_missing_photos(project):
    name, path = PhotoFiles(project).find("images/d.jpg")
    assert (name, path) == ("d.jpg", project / "images/d.jpg")
    with pytest.raises(InputError, match=r"d.jpg: no such image \(1 of 2 .*--images"):
        PhotoFiles(project).found(["images/d.jpg", "b"])


@pytest.mark.parametrize("name", [None, 3, "", "a\nb", "/", ".."])
def test_names_that_are_none(project, name):
    with pytest.raises(ValueError):
        PhotoFiles(project).find(name)
