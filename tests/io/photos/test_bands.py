"""Photos read a few rows at a time: the same bytes as whole ones, and never a whole one in memory."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from clsplat.camera import Camera
from clsplat.io.photos import resample
from clsplat.io.photos.images import read_image
from clsplat.io.photos.views import read_photo
from clsplat.scene import View
from clsplat.training.photos import decode

WIDTH, HEIGHT = 131, 97
CAMERA = Camera(WIDTH, HEIGHT, (90.0, 90.0), (65.0, 48.0), np.eye(3), np.zeros(3))
RNG = np.random.default_rng(0)
PIXELS = RNG.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
VALID = RNG.random((HEIGHT, WIDTH)) < 0.9
ORIENTED = Image.Exif()
ORIENTED[0x0112] = 6
LARGE = (1500, 1100)  # width and height of a photo that is not to be in memory


def sixteen_bits(path):
    import OpenImageIO as oiio

    output = oiio.ImageOutput.create(str(path))
    spec = oiio.ImageSpec(WIDTH, HEIGHT, 3, oiio.UINT16)
    spec.attribute("tiff:RowsPerStrip", 8)
    assert output.open(str(path), spec)
    assert output.write_image(RNG.integers(0, 1 << 16, (HEIGHT, WIDTH, 3), np.uint16))
    output.close()


def saved(**options):
    return lambda path: Image.fromarray(PIXELS).save(path, **options)


def with_alpha(path):
    Image.fromarray(np.dstack([PIXELS, VALID * np.uint8(255)])).save(path)


WRITERS = {
    "jpg": saved(quality=90),
    "progressive.jpg": saved(quality=90, progressive=True),
    "turned.jpg": saved(exif=ORIENTED),
    "png": saved(),
    "webp": saved(lossless=True),
    "16.png": sixteen_bits,
    "16.tif": sixteen_bits,
    "alpha.png": with_alpha,
}


@pytest.mark.parametrize("suffix", WRITERS)
@pytest.mark.parametrize("masked", [False, True])
def test_strips_give_the_bytes_of_the_whole_photo(tmp_path, monkeypatch, suffix, masked):
    path = tmp_path / f"a.{suffix}"
    WRITERS[suffix](path)
    view = View("a", CAMERA, path, transparent=suffix == "alpha.png")
    counts = VALID if view.transparent else np.ones_like(VALID)
    if masked:
        counts = counts & VALID[::-1]
        Image.fromarray(VALID[::-1] * np.uint8(255)).save(tmp_path / "mask.png")
        view = replace(view, mask=tmp_path / "mask.png")
    whole = read_image(path)
    monkeypatch.setattr(resample, "BAND_BYTES", 7 * 3 * WIDTH)
    for left, top, right, bottom in ((0, 0, WIDTH, HEIGHT), (16, 32, 117, 93)):
        cropped = CAMERA.cropped(left, top, right, bottom)
        for level in (1, 2.5, 4):
            camera = cropped.reduced(level)
            expected = resample.resample(whole[top:bottom, left:right], (camera.width, camera.height))
            planes = decode(replace(view, camera=camera))
            assert np.array_equal(planes[:3], expected.transpose(2, 0, 1))
            assert np.array_equal(read_photo(replace(view, camera=camera)), expected)
            if counts.all():
                assert len(planes) == 3
            elif level == 1:
                assert np.array_equal(planes[3] == 255, counts[top:bottom, left:right])


@pytest.fixture(scope="module")
def large(tmp_path_factory):
    """A view of a photo, with a mask."""
    folder = tmp_path_factory.mktemp("large")
    width, height = LARGE
    pixels = np.random.default_rng(1).integers(0, 256, (height, width, 3), np.uint8)
    for name in ("photo.jpg", "mask.png"):
        Image.fromarray(pixels | np.uint8(128)).save(folder / name)
    camera = Camera(width, height, (900.0, 900.0), (750.0, 550.0), np.eye(3), np.zeros(3))
    return View("a", camera, folder / "photo.jpg", mask=folder / "mask.png")


@pytest.mark.parametrize("part", ["level", "window", "whole"])
@pytest.mark.one_in(3)
def test_no_photo_is_in_memory_beside_what_is_asked_for(large, monkeypatch, part):
    monkeypatch.setattr(resample, "BAND_BYTES", 1 << 17)
    camera = {
        "level": large.camera.reduced(10),
        "whole": large.camera,
        "window": large.camera.cropped(640, 480, 800, 600),
    }[part]
    decode(replace(large, camera=camera))  # imports
    tracemalloc.start()
    decode(replace(large, camera=camera, mask=None))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.reset_peak()
    decode(replace(large, camera=camera))
    _, with_mask = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    whole = 3 * LARGE[0] * LARGE[1]
    assert peak < 4 * camera.width * camera.height + whole / 3
    assert part == "whole" or with_mask < peak + whole / 2  # of a mask one byte a pixel
