"""Masks beside photos and alpha: which pixels count, and messages about masks that do not fit."""

import numpy as np
import pytest
from PIL import Image

from clsplat.errors import InputError
from clsplat.io.photos.images import write_image
from clsplat.io.photos.views import read_valid
from clsplat.io.scenes.read import read_scene
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
    valid[:, :width // 2] = False
    return valid


@pytest.mark.parametrize("name", ["photo_1.png", "photo_1.png.png"])
def test_a_mask_is_found_by_name(folder, name):
    put_mask(folder, name, half())
    scene = read_scene(folder)
    assert [view.mask is not None for view in scene.views] == [False, True, False, False]
    assert any("1 of 4 photos have a mask" in note for note in scene.notes)
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


def test_windows_take_their_part_of_a_mask(folder):
    put_mask(folder, "photo_1.png", half())
    part = read_scene(folder).cropped({"photo_1.png": (20, 2, 30, 12)}).views[1]
    assert np.array_equal(read_valid(part), half()[2:12, 20:30])


def test_transparent_pixels_do_not_count(folder):
    pixels = np.full((HEIGHT, WIDTH, 4), 90, np.uint8)
    pixels[..., 3] = np.where(half(), 200, 40)
    Image.fromarray(pixels).save(folder / "images/photo_2.png")
    put_mask(folder, "photo_2.png", half().T[:1, :1].repeat(HEIGHT, 0).repeat(WIDTH, 1) | (
        np.arange(HEIGHT) > 5)[:, None])
    scene = read_scene(folder)
    assert any("1 of 4 photos have an alpha channel" in note for note in scene.notes)
    assert np.array_equal(read_valid(scene.views[2]), half() & (np.arange(HEIGHT) > 5)[:, None])


@pytest.mark.parametrize("spoil, words", [
    (lambda f: put_mask(f, "other.png", half()), "has no mask for any photo; name them after"),
    (lambda f: put_mask(f, "photo_1.png", half(30, 30)), "30x30 pixels and its photo 48x36"),
    (lambda f: write_image(f / "masks/photo_1.png", np.repeat(half()[..., None], 3, 2).astype(
        np.uint8)), "photo_1.png: its pixels are 0 and 1 of 255, which are both dark; write 255"),
    (lambda f: (f / "masks/photo_1.png").write_bytes(b"no"), "photo_1.png: not an image"),
])
def test_masks_that_do_not_fit(folder, spoil, words):
    (folder / "masks").mkdir()
    spoil(folder)
    with pytest.raises(InputError, match=words):
        read_valid(read_scene(folder).views[1])
