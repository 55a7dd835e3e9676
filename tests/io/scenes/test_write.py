"""Scenes that are written: with their files, or with photos that are encoded anew."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.io.photos.images import write_image
from clsplat.io.photos.views import read_photo, read_valid
from clsplat.io.scenes.read import read_scene
from clsplat.io.scenes.write import write_scene as write
from tests.data.tiny_model import HEIGHT, WIDTH, reconstruction, write_scene


@pytest.fixture
def scene(tmp_path):
    """Four photos of noise, of which the second has a mask."""
    folder = write_scene(tmp_path / "town")
    random = np.random.default_rng(0)
    for number in range(4):
        write_image(folder / f"images/photo_{number}.png", random.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8))
    mask = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    mask[:, : WIDTH // 2] = 255
    (folder / "masks").mkdir()
    write_image(folder / "masks/photo_1.png.png", mask)
    return read_scene(folder)


def check_place(written, scene):
    """The same model in the same coordinates, up to rounding."""
    assert [view.name for view in written.views] == [view.name for view in scene.views]
    assert np.allclose(written.points + written.offset, scene.points + scene.offset, atol=1e-9)
    assert np.array_equal(written.observations, scene.observations)
    assert np.array_equal(written.colours, scene.colours)
    for view, other in zip(written.views, scene.views):
        assert np.allclose(view.camera.position + written.offset, other.camera.position + scene.offset, atol=1e-9)


@pytest.mark.parametrize("linked", [True, False])
def test_files_are_linked_or_copied(tmp_path, scene, linked):
    write(tmp_path / "again", scene, linked=linked)
    read = read_scene(tmp_path / "again")
    check_place(read, scene)
    for view, other in zip(read.views, scene.views):
        assert view.source.is_symlink() == linked
        assert view.source.read_bytes() == other.source.read_bytes()
    assert [view.mask is None for view in read.views] == [True, False, True, True]


def test_smaller_photos(tmp_path, scene):
    write(tmp_path / "half", scene, downscale=2)
    read, small = read_scene(tmp_path / "half"), scene.reduced(2)
    check_place(read, scene)
    for view, other in zip(read.views, small.views):
        assert view.camera.focal == other.camera.focal
        assert np.abs(read_photo(view).astype(int) - read_photo(other)).mean() < 6  # JPEG of noise
    assert np.array_equal(read_valid(read.views[1]), read_valid(small.views[1]))


def test_photos_of_a_lens_are_written_without_it(tmp_path):
    made = reconstruction("SIMPLE_RADIAL", (50.0, WIDTH / 2, HEIGHT / 2, 0.1))
    scene = read_scene(write_scene(tmp_path / "town", made))
    write(tmp_path / "again", scene)
    read = read_scene(tmp_path / "again")
    check_place(read, scene)
    assert all(view.lens is None for view in read.views)
    assert read.views[0].camera.focal == scene.views[0].camera.focal


@pytest.mark.parametrize("kind", [np.uint16, np.float32, bytes])
def test_photos_that_are_no_files(tmp_path, scene, kind):
    photos = [read_photo(view) for view in scene.views]
    sources = [
        view.source.read_bytes()
        if kind is bytes
        else photo * np.uint16(257)
        if kind is np.uint16
        else photo / np.float32(255)
        for photo, view in zip(photos, scene.views)
    ]
    own = replace(
        scene, views=tuple(replace(view, source=source, mask=None) for view, source in zip(scene.views, sources))
    )
    assert all(np.array_equal(read_photo(view), photo) for view, photo in zip(own.views, photos))
    write(tmp_path / "again", own)
    read = read_scene(tmp_path / "again")
    check_place(read, scene)
    assert all(np.array_equal(read_photo(view), photo) for view, photo in zip(read.views, photos))
