"""Masks under the names of other programs: they are applied, and never become photos."""

import os
import shutil

import numpy as np
import pytest
from PIL import Image

from clsplat.errors import InputError
from clsplat.io.photos.mask_files import photo_of
from clsplat.io.photos.views import read_valid
from clsplat.io.scenes.read import read_scene
from clsplat.sfm.photos import find_photos
from tests.data.tiny_model import write_scene
from tests.io.shared_cases import CASES, needs_cases

DARK_LEFT = np.tile(np.where(np.arange(48) < 24, 0, 255).astype(np.uint8), (36, 1))
# names of the mask of photo_1.png, from the scene's folder
NAMES = ("masks/photo_1.png", "masks/photo_1.png.png", "masks/photo_1.JPG",
         "masks/photo_1_mask.png", "mask/photo_1.png", "image_masks/photo_1.bmp",
         "images_mask/photo_1.png.jpg",
         "images/photo_1_mask.jpg", "images/photo_1_mask.png", "images/photo_1_MASK.tif",
         "images/photo_1.png.mask.png", "images/photo_1.mask.png", "images/.mask/photo_1.png",
         "images/masks/photo_1.png", "images/mask/photo_1.png.png")


def put(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.repeat(DARK_LEFT[..., None], 3, 2)).save(path)


@needs_cases
@pytest.mark.parametrize("name", ["photos_odm_mask", "photos_realityscan_mask",
                                  "photos_masks_folder_same_name"])
def test_cases(name):
    photos, refused = find_photos(CASES / name)
    assert [photo.name for photo in photos] == [f"DJI_000{n}.JPG" for n in range(6)]
    assert all(photo.mask is not None and photo.name[:8] in photo.mask.name for photo in photos)
    assert refused == {}


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", NAMES)
def test_a_scene_uses_the_mask(tmp_path, name):
    folder = write_scene(tmp_path / "town")
    put(folder / name)
    scene = read_scene(folder)
    assert [view.mask is not None for view in scene.views] == [False, True, False, False]
    valid = read_valid(scene.views[1])  # JPEG may spoil the pixels at the border
    assert not valid[:, :23].any() and valid[:, 25:].all()
    note, = (note for note in scene.notes if "have a mask" in note)
    assert note.startswith("1 of 4 photos have a mask in ")


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("below", ["", "images/"])
def test_a_reconstruction_uses_the_mask(tmp_path, name, below):
    """Of photos in images/, or in the folder itself."""
    folder = write_scene(tmp_path / "town")
    shutil.rmtree(folder / "sparse")
    put(folder / name)
    if not below:
        for path in (folder / "images").iterdir():
            path.rename(folder / path.name)
        (folder / "images").rmdir()
    photos, refused = find_photos(folder)
    assert [photo.name for photo in photos] == [f"photo_{n}.png" for n in range(4)]
    assert [photo.mask is not None for photo in photos] == [False, True, False, False]
    assert refused == {}


@pytest.mark.parametrize("name", ["other_mask.png", "photo_9.png.mask.png", "sub/photo_1_mask.jpg"])
def test_masks_without_a_photo_are_named_and_not_used(tmp_path, name):
    folder = write_scene(tmp_path / "town") / "images"
    put(folder / name)
    photos, refused = find_photos(folder)
    assert len(photos) == 4 and not any(photo.mask for photo in photos)
    assert refused == {name: "it is named as a mask, and the photo is missing: it is not used"}
    put(folder / "masks/photo_1.png")
    put(folder / "masks/photo_9.png")
    photos, refused = find_photos(folder)
    assert len(photos) == 4 and photos[1].mask == folder / "masks/photo_1.png"
    assert set(refused) == {name, "masks/photo_9.png"}


def test_masks_of_subfolders_are_those_of_their_photos(tmp_path):
    folder = write_scene(tmp_path / "town") / "images"
    for name in ("a/x.png", "b/x.png", "x.png"):
        put(folder / name)
    for name in ("a/mask/x.png", "masks/b/x.png"):
        put(folder / name)
    found = {photo.name: photo.mask for photo in find_photos(folder)[0]}
    assert found["a/x.png"] == folder / "a/mask/x.png"
    assert found["b/x.png"] == folder / "masks/b/x.png" and found["x.png"] is None


def test_masks_of_a_scene_below_the_photos_are_not_theirs(tmp_path):
    folder = write_scene(tmp_path / "town") / "images"
    put(folder / "scene/masks/photo_1.png")
    put(folder / "scene/images/photo_1.png")
    (folder / "scene/sfm.json").touch()
    photos, refused = find_photos(folder)
    assert len(photos) == 4 and not any(photo.mask for photo in photos) and refused == {}


def test_folders_that_link_to_themselves(tmp_path):
    folder = write_scene(tmp_path / "town") / "images"
    os.symlink(folder, folder / "masks")
    photos, _ = find_photos(folder)
    assert [photo.name for photo in photos] == [f"photo_{n}.png" for n in range(4)]
    assert not any(photo.mask for photo in photos)


def test_a_folder_beside_the_photos_without_any_of_their_masks(tmp_path):
    folder = write_scene(tmp_path / "town")
    put(folder / "mask/other.png")
    for read in (find_photos, read_scene):
        with pytest.raises(InputError, match="mask: has (no mask for any photo|a mask for none)"):
            read(folder)


@pytest.mark.parametrize("name, photo", [
    ("a_mask.JPG", "a"), ("a.JPG.mask.png", "a.JPG"), ("a.mask.tif", "a"), ("a_mask_mask.png",
                                                                         "a_mask"),
    ("a.jpg", ""), ("mask.png", ""), ("_mask.png", ""), ("amask.png", ""), ("a_mask.txt", ""),
    ("a_masks.png", ""), ("a_mask_1.png", ""), ("x/a_mask.png", "a")])
def test_names_of_masks(name, photo):
    assert photo_of(name) == photo
