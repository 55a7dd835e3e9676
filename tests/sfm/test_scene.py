"""A scene has the photos and masks as they were taken, and a model that fits them."""

import errno
import os

import numpy as np
import pytest

from clsplat.io.photos.images import read_image, write_image
from clsplat.io.photos.metadata import PhotoMetadata
from clsplat.io.photos.views import read_photo
from clsplat.io.scenes.read import read_scene
from clsplat.sfm.photos import SourcePhoto
from clsplat.sfm.reconstruct import write_scene
from tests.sfm.cases import Lines, synthetic


@pytest.fixture
def made(tmp_path):
    """A scene of a synthetic reconstruction with distortion, whose photos have at each pixel a
    colour that names it; the last has a mask."""
    model = synthetic()
    y, x = np.mgrid[:240, :320]
    pixels = np.stack([x * 0.75, y, np.zeros_like(x)], axis=2).astype(np.uint8)
    mask = np.full((240, 320, 3), 255, np.uint8)
    mask[:, :160] = 5  # nearly black
    write_image(tmp_path / "mask.png", mask)
    photos = []
    for number, image in sorted(dict(model.images).items()):
        image.name = f"sub/{number}.png"
        write_image(tmp_path / f"{number}.png", pixels)
        photos.append(
            SourcePhoto(
                image.name,
                tmp_path / f"{number}.png",
                PhotoMetadata(320, 240),
                tmp_path / "mask.png" if number == 6 else None,
            )
        )
    names = write_scene(tmp_path / "scene", model, photos, Lines())
    assert names == [photo.name for photo in photos]
    return tmp_path / "scene", model, photos


def test_points_are_where_the_undistorted_photos_show_them(made):
    folder, model, _ = made
    scene = read_scene(folder)
    assert len(scene.views) == 6 and len(scene.points) == 60
    assert [path.name for path in (folder / "masks/sub").iterdir()] == ["6.png.png"]
    assert [view.mask is not None for view in scene.views] == 5 * [False] + [True]
    compared = 0
    for view, image in zip(scene.views, (model.images[number] for number in range(1, 7))):
        assert view.lens is not None
        photo = read_photo(view).astype(float)
        for point in image.points2D:
            if not point.has_point3D():
                continue
            place = model.points3D[point.point3D_id].xyz - scene.offset
            (x, y), _ = (np.squeeze(value) for value in view.camera.project(place[None]))
            if 2 < x < photo.shape[1] - 2 and 2 < y < photo.shape[0] - 2:
                # the colour tells which pixel of the photo as stored this was
                assert np.abs((photo[int(y), int(x)] / (0.75, 1, 1))[:2] - point.xy).max() < 2.5
                compared += 1
    assert compared > 150


def test_points_have_the_colours_of_the_photos(made):
    folder, model, _ = made
    numbers = sorted(model.point3D_ids())
    seen = [
        [
            model.images[element.image_id].points2D[element.point2D_idx].xy
            for element in model.point3D(number).track.elements
        ]
        for number in numbers
    ]
    expected = [np.mean(np.floor(at), axis=0) * (0.75, 1) for at in seen]
    colours = read_scene(folder).colours
    assert np.abs(colours[:, :2] - expected).max() < 1.6 and not colours[:, 2].any()


@pytest.mark.parametrize("has_links", [True, False])
def test_photos_outlive_their_source_and_are_not_written_again(made, monkeypatch, has_links):
    folder, model, photos = made
    if not has_links:

        def refuse(*_):
            raise OSError(errno.EXDEV, "another disk")

        monkeypatch.setattr(os, "link", refuse)
    first, other = folder / "images" / photos[0].name, folder / "images" / photos[1].name
    before = read_image(first)
    first.unlink()
    kept = other.stat().st_ino, other.stat().st_mtime_ns
    write_scene(folder, model, photos, Lines())
    assert (other.stat().st_ino, other.stat().st_mtime_ns) == kept
    assert (first.stat().st_ino == photos[0].path.stat().st_ino) == has_links
    photos[0].path.unlink()
    assert np.array_equal(read_image(first), before)
