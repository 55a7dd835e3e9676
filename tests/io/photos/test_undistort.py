"""Undistorted photos in the files of a run: made once, and again if something has changed."""

import os

import numpy as np
import pytest

from clsplat.io.photos import undistort as module
from clsplat.io.photos.depth import read_depth, with_depths
from clsplat.io.photos.images import read_image, write_image
from clsplat.io.photos.undistort import undistorted
from clsplat.io.photos.views import read_photo, read_valid
from clsplat.io.scenes.read import fingerprint, read_scene
from tests.data.tiny_model import HEIGHT, WIDTH, reconstruction, write_scene

RADIAL = ("SIMPLE_RADIAL", (50.0, 24.0, 18.0, -0.1))


@pytest.fixture
def folder(tmp_path):
    """A scene with a lens, and photos that are not of one colour."""
    write_scene(tmp_path / "town", reconstruction(*RADIAL))
    rng = np.random.default_rng(0)
    for path in sorted((tmp_path / "town/images").iterdir()):
        write_image(path, rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8))
    return tmp_path / "town"


def counted(monkeypatch):
    """The views that are undistorted from now on."""
    made, undistorted_photo = [], module.undistorted_photo

    def noted(view, pixels):
        made.append(view.name)
        return undistorted_photo(view, pixels)

    monkeypatch.setattr(module, "undistorted_photo", noted)
    return made


def test_files_are_used_again_until_something_changes(folder, tmp_path, monkeypatch):
    made, scene, kept = counted(monkeypatch), read_scene(folder), tmp_path / "run/kept"
    assert any("undistorted from a lens (SIMPLE_RADIAL)" in note for note in scene.notes)
    first = undistorted(scene, kept, threads=2)
    assert sorted(made) == [view.name for view in scene.views]
    assert all(view.lens is None and view.source.parent == kept for view in first.views)
    for direct, view in zip(scene.views, first.views):
        assert np.array_equal(read_photo(view), read_photo(direct))  # PNG loses nothing
    assert fingerprint(first) == fingerprint(scene)
    made.clear()
    undistorted(read_scene(folder), kept)
    assert not made
    write_image(folder / "images/photo_1.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    again = undistorted(read_scene(folder), kept)
    assert made == ["photo_1.png"] and not read_photo(again.views[1]).any()
    made.clear()
    write_scene(folder, reconstruction("SIMPLE_RADIAL", (50.0, 24.0, 18.0, -0.15)))
    undistorted(read_scene(folder), kept)
    assert len(made) == 4


def test_missing_files_are_made_again_if_they_may(folder, tmp_path, monkeypatch):
    scene, kept = read_scene(folder), tmp_path / "kept"
    assert all(view.lens for view in undistorted(scene, kept, make=False).views)
    assert not kept.exists()
    undistorted(scene, kept)
    made = counted(monkeypatch)
    next(kept.glob("photo_2*.png")).unlink()
    found = undistorted(scene, kept, make=False)
    assert [view.lens is None for view in found.views] == [True, True, False, True] and not made
    undistorted(scene, kept)
    assert made == ["photo_2.png"] and len(list(kept.iterdir())) == 4


def test_masks_and_depth_maps_go_with_their_photos(folder, tmp_path):
    """A mask and a depth map that tell the column, as the photo does."""
    columns = np.tile(np.arange(WIDTH), (HEIGHT, 1))
    write_image(folder / "images/photo_0.png", np.repeat(columns[..., None] * 5, 3, 2).astype(np.uint8))
    (folder / "masks").mkdir()
    write_image(folder / "masks/photo_0.png", np.repeat(columns[..., None] >= 20, 3, 2) * np.uint8(255))
    (folder / "depth").mkdir()
    np.save(folder / "depth/photo_0.npy", columns + 1.0)
    scene = with_depths(read_scene(folder), "depth")
    kept = undistorted(scene, tmp_path / "kept")
    for view in (scene.views[0], kept.views[0]):
        photo, valid, depth = read_photo(view)[..., 0] / 5, read_valid(view), read_depth(view)
        assert 0.4 < valid.mean() < 0.7
        # beside its own column, a pixel has a share of two others
        assert (photo[valid] > 20.8).all() and (photo[~valid] < 21.2).all()
        assert np.abs(depth - 1 - photo).max() <= 0.71  # the nearest; photos are interpolated
    assert np.array_equal(read_depth(kept.views[0]), read_depth(scene.views[0]))
    assert kept.views[1].mask is None and kept.views[1].depth is None
    # an evaluation, which knows no depth maps, uses the files too
    plain = undistorted(read_scene(folder), tmp_path / "kept", make=False).views[0]
    assert plain.lens is None and plain.source == kept.views[0].source and plain.depth is None
    for path in ("depth/photo_0.npy", "masks/photo_0.png"):
        undistorted(scene, tmp_path / "kept")
        assert undistorted(scene, tmp_path / "kept", make=False).views[0].lens is None
        os.utime(folder / path, (1, 1))
        assert undistorted(scene, tmp_path / "kept", make=False).views[0].lens


def test_smaller_photos_and_reduced_cameras(folder, tmp_path):
    (folder / "images_2").mkdir()
    for path in sorted((folder / "images").iterdir()):
        write_image(folder / "images_2" / path.name, read_image(path, (WIDTH // 2, HEIGHT // 2)))
    whole, small = read_scene(folder), read_scene(folder, "images_2")
    camera, lens = small.views[0].camera, small.views[0].lens
    assert abs(camera.width - whole.views[0].camera.width / 2) <= 1
    assert (camera.width, camera.height) == (lens.width, lens.height)
    assert all(view.lens is lens for view in small.views)  # one map of pixels for all
    for scene in (small, small.reduced(2)):
        view = scene.views[0]
        shape = view.camera.height, view.camera.width, 3
        assert read_photo(view).shape == shape
        assert read_photo(undistorted(scene, tmp_path / "kept").views[0]).shape == shape
    part = whole.cropped({"photo_0.png": (5, 6, 25, 30)})
    assert np.array_equal(read_photo(part.views[0]), read_photo(whole.views[0])[6:30, 5:25])
