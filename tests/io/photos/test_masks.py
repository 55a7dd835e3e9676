"""Masks beside photos and alpha: which pixels count, and messages about masks that do not fit."""

import shutil

import numpy as np
import pytest
from PIL import Image

from clsplat.errors import InputError
from clsplat.io.photos.images import write_image
from clsplat.io.photos.views import read_valid
from clsplat.io.scenes.read import read_scene
from clsplat.sfm.photos import find_photos
from clsplat.training.photos import decode
from tests.data.tiny_model import HEIGHT, WIDTH, write_scene


@pytest.fixture
def folder(tmp_path):
    return write_scene(tmp_path / "town")


def put_mask(folder, name, valid):
    (folder / "masks").mkdir(exist_ok=True)
    write_image(folder / "masks" / name, np.repeat(valid[..., None], 3, 2) * np.uint8(255))


def half(width=WIDTH, height=HEIGHT):
    valid = np.ones((height, width), bool)
    valid[:, : width // 2] = False
    return valid


def test_masked_pixels_do_not_count(folder):
    put_mask(folder, "photo_1.png", half())
    scene = read_scene(folder)
    assert np.array_equal(read_valid(scene.views[1]), half()) and read_valid(scene.views[0]) is None
    planes = decode(scene.views[1])
    assert planes.shape == (4, HEIGHT, WIDTH) and np.array_equal(planes[3] == 255, half())
    assert not planes[3][~half()].any() and decode(scene.views[0]).shape[0] == 3


def test_a_reduced_pixel_counts_if_all_that_it_covers_do(folder):
    valid = np.ones((HEIGHT, WIDTH), bool)
    valid[7, 9] = False
    put_mask(folder, "photo_1.png", valid)
    small = read_valid(read_scene(folder).reduced(3).views[1])
    expected = np.ones((HEIGHT // 3, WIDTH // 3), bool)
    expected[2, 3] = False
    assert np.array_equal(small, expected)
    put_mask(folder, "photo_1.png", np.ones((HEIGHT, WIDTH), bool))
    assert read_valid(read_scene(folder).views[1]) is None  # a mask of all is none


def test_transparent_pixels_do_not_count(folder):
    pixels = np.full((HEIGHT, WIDTH, 4), 90, np.uint8)
    pixels[..., 3] = np.where(half(), 200, 40)
    Image.fromarray(pixels).save(folder / "images/photo_2.png")
    put_mask(
        folder, "photo_2.png", half().T[:1, :1].repeat(HEIGHT, 0).repeat(WIDTH, 1) | (np.arange(HEIGHT) > 5)[:, None]
    )
    scene = read_scene(folder)
    assert any("1 of 4 photos have an alpha channel" in note for note in scene.notes)
    assert np.array_equal(read_valid(scene.views[2]), half() & (np.arange(HEIGHT) > 5)[:, None])


@pytest.mark.parametrize(
    "spoil, words",
    [
        (lambda f: put_mask(f, "other.png", half()), "has no mask for any photo; name them after"),
        (lambda f: put_mask(f, "photo_1.png", half(30, 30)), "30x30 pixels and its photo 48x36"),
        (
            lambda f: write_image(f / "masks/photo_1.png", np.repeat(half()[..., None], 3, 2).astype(np.uint8)),
            "photo_1.png: its pixels are 0 and 1 of 255, which are both dark; write 255",
        ),
        (lambda f: (f / "masks/photo_1.png").write_bytes(b"no"), "photo_1.png: not an image"),
    ],
)
def test_masks_that_do_not_fit(folder, spoil, words):
    (folder / "masks").mkdir()
    spoil(folder)
    with pytest.raises(InputError, match=words):
        read_valid(read_scene(folder).views[1])


DARK_LEFT = np.tile(np.where(np.arange(48) < 24, 0, 255).astype(np.uint8), (36, 1))
# names of the mask of photo_1.png, from the scene's folder
NAMES = (
    "masks/photo_1.png",
    "masks/photo_1.png.png",
    "mask/photo_1.bmp",
    "images/photo_1_MASK.tif",
    "images/photo_1.png.mask.png",
    "images/.mask/photo_1.png",
    "images/mask/photo_1.png.png",
)


def put(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.repeat(DARK_LEFT[..., None], 3, 2)).save(path)


@pytest.mark.parametrize("name", NAMES)
def test_a_scene_and_a_reconstruction_use_the_mask(folder, name):
    put(folder / name)
    scene = read_scene(folder)
    assert [view.mask is not None for view in scene.views] == [False, True, False, False]
    valid = read_valid(scene.views[1])
    assert not valid[:, :23].any() and valid[:, 25:].all()
    (note,) = (note for note in scene.notes if "have a mask" in note)
    assert note.startswith("1 of 4 photos have a mask in ")
    shutil.rmtree(folder / "sparse")
    photos, refused = find_photos(folder)
    assert [photo.name for photo in photos] == [f"photo_{n}.png" for n in range(4)]
    assert [photo.mask is not None for photo in photos] == [False, True, False, False]
    assert refused == {}


def test_masks_without_a_photo_are_not_used(folder):
    for name in ("images/other_mask.png", "images/masks/photo_9.png", "images/masks/photo_1.png"):
        put(folder / name)
    photos, refused = find_photos(folder / "images")
    assert len(photos) == 4 and photos[1].mask == folder / "images/masks/photo_1.png"
    assert refused == {}


def test_masks_of_subfolders_are_those_of_their_photos(folder):
    folder = folder / "images"
    for name in ("a/x.png", "b/x.png", "x.png"):
        put(folder / name)
    for name in ("a/mask/x.png", "masks/b/x.png"):
        put(folder / name)
    found = {photo.name: photo.mask for photo in find_photos(folder)[0]}
    assert found["a/x.png"] == folder / "a/mask/x.png"
    assert found["b/x.png"] == folder / "masks/b/x.png" and found["x.png"] is None


def test_a_folder_beside_the_photos_without_any_of_their_masks(folder):
    put(folder / "mask/other.png")
    for read in (find_photos, read_scene):
        with pytest.raises(InputError, match="mask: has (no mask for any photo|a mask for none)"):
            read(folder)
