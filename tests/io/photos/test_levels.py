"""Grey photos with 16 bits of which few are used are stretched alike, whatever reads them."""

from dataclasses import replace

import numpy as np
import pytest
import tifffile
from PIL import Image

from clsplat.io.photos.metadata import read_metadata
from clsplat.io.photos.photo import common_levels
from clsplat.io.photos.views import read_photo
from clsplat.io.scenes.read import read_scene
from clsplat.io.scenes.write import write_scene as write
from clsplat.sfm.photos import find_photos
from tests.data.tiny_model import HEIGHT, WIDTH, write_scene
from tests.io.shared_cases import CASES, needs_cases

LOW, HIGH = 29000, 29800


def ramp(number, low=LOW, high=HIGH):
    """Samples of a photo, whose own range is a part of that of the set."""
    part = np.linspace(low + number * (high - low) / 8, high - (3 - number) * (high - low) / 8, HEIGHT * WIDTH)
    return part.round().astype(np.uint16).reshape(HEIGHT, WIDTH)


@pytest.fixture
def folder(tmp_path):
    """A scene whose photos have 16 bits."""
    folder = write_scene(tmp_path / "town")
    for number in range(4):
        Image.fromarray(ramp(number)).save(folder / f"images/photo_{number}.png")
    return folder


def levels_of(paths):
    return common_levels(paths, [read_metadata(path).is_deep for path in paths])[0]


@needs_cases
def test_case():
    photos, _ = find_photos(CASES / "photos_thermal_16bit")
    levels, notes = common_levels([photo.path for photo in photos], 6 * [True])
    assert set(levels) == {(29097.0, 29705.0)}
    assert notes == [
        "6 of 6 photos are grey with 16 bits, of which they use 29097 to 29705: all are stretched alike to 8 bits"
    ]


def test_a_scene_is_stretched_as_a_whole(folder):
    scene = read_scene(folder)
    low, high = scene.views[0].levels
    assert LOW <= low < LOW + 5 and HIGH - 5 < high <= HIGH
    assert any("4 of 4 photos are grey with 16 bits" in note for note in scene.notes)
    for number, view in enumerate(scene.views):
        expected = np.clip((ramp(number) - low) / (high - low) * 255, 0, 255)
        assert np.abs(read_photo(view).astype(float) - expected[..., None]).max() <= 0.51
    small = read_photo(scene.reduced(2).views[1])
    assert abs(small.mean() - read_photo(scene.views[1]).mean()) < 1


def test_a_scene_that_is_written_keeps_the_levels(folder, tmp_path):
    scene = read_scene(folder)
    write(tmp_path / "block", replace(scene, views=scene.views[:2], observations=None))
    for view, other in zip(read_scene(tmp_path / "block").views, scene.views):
        assert view.levels is None and np.array_equal(read_photo(view), read_photo(other))


@pytest.mark.parametrize(
    "samples",
    [
        ramp(0, 0, 32000),
        np.full((HEIGHT, WIDTH), 29000, np.uint16),
        ramp(0).astype(np.uint8),
        np.repeat(ramp(0)[..., None], 3, 2),
    ],
)
def test_other_photos_are_read_as_they_were(tmp_path, samples):
    tifffile.imwrite(tmp_path / "a.tif", samples)
    assert levels_of([tmp_path / "a.tif"]) == [None]


def test_dead_pixels_do_not_count(tmp_path):
    samples = np.tile(ramp(0), (6, 6))
    samples[3, 5], samples[7, 9] = 0, 65535
    tifffile.imwrite(tmp_path / "a.tif", samples)
    low, high = levels_of([tmp_path / "a.tif"])[0]
    assert LOW <= low < high <= HIGH
