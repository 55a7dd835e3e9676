"""Photos are written and read without loss, and messages name damaged ones."""

import shutil
from types import SimpleNamespace

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.io.photos import images
from clsplat.io.photos.photo import opened
from tests.refusals import refused


def smooth(height, width):
    """A smooth uint8[height, width, 3], which JPEG keeps well."""
    y, x = np.mgrid[:height, :width] / max(height, width)
    return (np.stack([x, y, (x + y) / 2], axis=2) * 200 + 20).astype(np.uint8)


def test_png_is_exact_and_size_is_width_first(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (17, 31, 3), dtype=np.uint8)
    images.write_image(tmp_path / "a.png", pixels)
    read = images.read_image(tmp_path / "a.png")
    assert read.dtype == np.uint8 and np.array_equal(read, pixels)
    assert images.image_size(tmp_path / "a.png") == (31, 17)


def test_float_is_clipped_and_rounded(tmp_path):
    pixels = np.array([[[-1.0, 0.5, 2.0], [np.nan, 0.1, 254.6 / 255]]], np.float32)
    images.write_image(tmp_path / "a.png", pixels)
    assert images.read_image(tmp_path / "a.png").tolist() == [[[0, 128, 255], [0, 26, 255]]]


def test_jpeg_quality_and_bytes_source(tmp_path):
    pixels = smooth(40, 64)
    for quality in (30, 96):
        images.write_image(tmp_path / f"{quality}.jpg", pixels, quality=quality)
    fine, coarse = ((tmp_path / f"{q}.jpg").read_bytes() for q in (96, 30))
    assert len(fine) > len(coarse)
    assert np.abs(images.read_image(fine).astype(int) - pixels).mean() < 1
    assert images.image_size(fine) == (64, 40)
    images.write_image(tmp_path / "again.jpg", pixels, quality=96)
    assert (tmp_path / "again.jpg").read_bytes() == fine


def area_mean(pixels, size):
    """`resample` by its definition, a pixel at a time, in float64."""
    height, width = pixels.shape[:2]
    out = np.zeros((size[1], size[0], 3))
    for axis_y in range(size[1]):
        y = np.clip(
            np.minimum((axis_y + 1) * height / size[1], np.arange(height) + 1)
            - np.maximum(axis_y * height / size[1], np.arange(height)),
            0,
            None,
        )
        for axis_x in range(size[0]):
            x = np.clip(
                np.minimum((axis_x + 1) * width / size[0], np.arange(width) + 1)
                - np.maximum(axis_x * width / size[0], np.arange(width)),
                0,
                None,
            )
            out[axis_y, axis_x] = np.einsum("y,x,yxc->c", y, x, pixels) / (y.sum() * x.sum())
    return out


@pytest.mark.parametrize("size", [(15, 10), (31, 7), (60, 40)])
def test_resampling_is_the_mean_over_the_covered_area(tmp_path, size):
    pixels = np.random.default_rng(1).integers(0, 256, (30, 45, 3), dtype=np.uint8)
    images.write_image(tmp_path / "a.png", pixels)
    read = images.read_image(tmp_path / "a.png", size)
    assert read.shape == (size[1], size[0], 3) and read.flags.c_contiguous
    assert np.abs(read - area_mean(pixels, size)).max() <= 0.5 + 1e-3


@pytest.mark.parametrize("share", [0.0, 0.02, 0.7])
@pytest.mark.parametrize("suffix", ["jpg", "tif"])
def test_truncated_is_refused(tmp_path, suffix, share):
    path = tmp_path / f"photo.{suffix}"
    images.write_image(path, np.random.default_rng(2).integers(0, 256, (64, 48, 3), dtype=np.uint8))
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    refused(lambda: images.read_image(path), f"photo.{suffix}")


def test_not_an_image(tmp_path):
    (tmp_path / "text.jpg").write_text("hello " * 99)
    for path in (tmp_path / "text.jpg", tmp_path / "missing.jpg", tmp_path):
        for function in (images.read_image, images.image_size):
            with pytest.raises(InputError, match=path.name):
                function(path)
    refused(lambda: images.read_image(b"hello " * 99), "encoded image")


def test_arrays_are_photos():
    grey = np.arange(12, dtype=np.uint16).reshape(3, 4) * 5000
    with opened(grey) as photo:
        assert photo.is_deep and (photo.width, photo.height) == (4, 3) and not photo.has_alpha
    assert np.array_equal(images.read_image(grey)[..., 1], np.rint(grey / 257))
    assert np.array_equal(images.read_image(grey, levels=(0, 55000))[..., 2], np.rint(grey / 55000 * 255))
    with_alpha = np.random.default_rng(0).random((3, 4, 4), np.float32) * 2 - 0.5
    with_alpha[0, 0, 0] = np.nan
    assert np.array_equal(images.read_image(with_alpha), images.eight_bits(with_alpha[..., :3]))
    assert np.array_equal(images.read_alpha(with_alpha), images.eight_bits(with_alpha[..., 3]))
    for wrong in (np.zeros((3, 4, 5), np.uint8), np.zeros((3, 4)), np.zeros(3, np.uint8)):
        with pytest.raises(InputError, match="give uint8, uint16 or float32"):
            images.read_image(wrong)


def test_unwritable(tmp_path):
    pixels = smooth(4, 4)
    refused(lambda: images.write_image(tmp_path / "nowhere" / "a.png", pixels), "nowhere")
    refused(lambda: images.write_image(tmp_path / "a.xyz", pixels), "a.xyz")


def test_a_full_temporary_folder_is_named(tmp_path, monkeypatch):
    """Else OpenImageIO would report success."""
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=1 << 19))
    with pytest.raises(InputError, match="a.jpg: the folder for temporary files, .* is near"):
        images.write_image(tmp_path / "a.jpg", smooth(4, 4))
