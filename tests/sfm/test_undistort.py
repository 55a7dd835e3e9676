"""Scenes have photos without distortion, upright, with cameras, masks and colours that fit."""

import numpy as np
import pytest

from clsplat.io.photos.images import read_image, write_image
from clsplat.io.photos.metadata import PhotoMetadata
from clsplat.io.scenes.colmap import read_colmap
from clsplat.sfm.photos import SourcePhoto
from clsplat.sfm.undistort import output_names, write_scene
from tests.sfm.cases import Lines, synthetic


@pytest.fixture
def made(tmp_path):
    """A scene of a synthetic reconstruction, whose photos show where each pixel was before; the
    orientations of the photos are 1, 3, 6, 8, 1, 1 and the last has a mask."""
    model = synthetic()
    y, x = np.mgrid[:240, :320]
    pixels = np.stack([x * 0.75, y, np.zeros_like(x)], axis=2).astype(np.uint8)
    mask = np.full((240, 320, 3), 255, np.uint8)
    mask[:, :160] = 5  # nearly black
    write_image(tmp_path / "mask.png", mask)
    photos = []
    for (_, image), turn in zip(sorted(dict(model.images).items()), (1, 3, 6, 8, 1, 1)):
        image.name = f"sub/{image.image_id}.png"
        path = tmp_path / f"{image.image_id}.png"
        write_image(path, pixels)
        photos.append(SourcePhoto(image.name, path, PhotoMetadata(320, 240, turn),
                                  tmp_path / "mask.png" if image.image_id == 6 else None))
    names = write_scene(tmp_path / "scene", model, photos, Lines())
    assert names == [photo.name for photo in photos]
    return tmp_path / "scene", model, photos


def test_points_are_where_the_photos_show_them(made):
    folder, model, _ = made
    scene = read_colmap(folder)
    assert len(scene.views) == 6 and len(scene.points) == 60
    sizes = [(view.camera.width, view.camera.height) for view in scene.views]
    assert sizes[0] == sizes[1] == sizes[2][::-1] == sizes[3][::-1]
    compared = 0
    for view, image in zip(scene.views, (model.images[number] for number in range(1, 7))):
        photo = read_image(view.source).astype(float)
        for point in image.points2D:
            if not point.has_point3D():
                continue
            place = model.points3D[point.point3D_id].xyz - scene.offset
            (x, y), _ = (np.squeeze(value) for value in view.camera.project(place[None]))
            if not (2 < x < photo.shape[1] - 2 and 2 < y < photo.shape[0] - 2):
                continue
            # the colour tells which pixel of the photo as stored this was
            shown = photo[int(y), int(x)] / (0.75, 1, 1)
            assert np.abs(shown[:2] - point.xy).max() < 2.5
            compared += 1
    assert compared > 150


def test_masks_go_with_their_photos(made):
    folder, _, photos = made
    assert [path.name for path in (folder / "masks/sub").iterdir()] == ["6.png.png"]
    mask = read_image(folder / "masks/sub/6.png.png")
    photo = read_image(folder / "images/sub/6.png")
    assert mask.shape == photo.shape and set(np.unique(mask)) == {0, 255}
    left = photo[..., 0] / 0.75 < 158
    assert not mask[left].any() and mask[photo[..., 0] / 0.75 > 163].all()


def test_points_have_the_colours_of_the_photos(made):
    folder, _, _ = made
    scene = read_colmap(folder)
    assert scene.colours[:, 2].max() == 0 and scene.colours[:, :2].std() > 10


def test_photos_that_are_there_are_not_written_again(made):
    folder, model, photos = made
    before = {path: path.stat().st_mtime_ns for path in (folder / "images").rglob("*.png")}
    removed = min(before)
    removed.unlink()
    write_scene(folder, model, photos, Lines())
    after = {path: path.stat().st_mtime_ns for path in (folder / "images").rglob("*.png")}
    assert after.keys() == before.keys()
    assert [path for path in after if after[path] != before[path]] == [removed]


def test_names_of_formats_that_are_not_written_become_png():
    assert output_names(["a.JPG", "b.tif", "c.tif", "c.png"]) == {
        "a.JPG": "a.JPG", "b.tif": "b.png", "c.tif": "c.tif.png", "c.png": "c.png"}
