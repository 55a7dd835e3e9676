"""Which image beside a photo is its mask or its depth map."""

from dataclasses import replace
from pathlib import Path

import pytest

from clsplat.camera import Camera
from clsplat.io.photos.beside import file_beside
from clsplat.scene import View

CAMERA = Camera.looking_at((0, 0, 0), (1, 2, 3))
FACE = View("far/a.left.jpg", CAMERA, Path("images/far/a.jpg"))  # of a panorama


@pytest.mark.parametrize("view, found", [
    (View("far/a.jpg", CAMERA, Path("images/far/a.jpg")), ["far/a.jpg.png", "far/a.png"]),
    (View("far/a.jpg", CAMERA, b"packed"), ["far/a.jpg.png", "far/a.png"]),
    (FACE, ["far/a.jpg.png", "far/a.png"])])
def test_an_image_has_the_name_of_the_photo_with_or_without_its_suffix(tmp_path, view, found):
    assert file_beside(tmp_path, view) is None
    (tmp_path / "far").mkdir()
    for name in ("far/b.png", "far/a.exr", *reversed(found)):
        (tmp_path / name).touch()
        if name in found:
            assert file_beside(tmp_path, view) == tmp_path / name
    assert file_beside(tmp_path, view, (".exr",)) == tmp_path / "far/a.exr"
    other = replace(view, name=view.name.replace("a", "c"), source=b"packed")
    assert file_beside(tmp_path, other) is None
