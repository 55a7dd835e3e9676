"""Photos under fuzz: how valid files of each format are made, and how a mutated one is read."""

import numpy as np
from PIL import Image

from clsplat.io.photos.images import image_size, read_image, write_image
from clsplat.io.photos.metadata import read_metadata
from tests.io.photos.test_profiles import COLOURS, SPACES


def numbered(folder, items):
    """(a folder of its own, made, item) of each."""
    for number, item in enumerate(items):
        (folder / str(number)).mkdir()
        yield folder / str(number), item


def finite(*values):
    assert all(value is None or np.isfinite(value).all() for value in values)


def made_images(folder):
    noise = np.random.default_rng(0).integers(0, 256, (24, 32, 4), dtype=np.uint8)
    for seed, (name, channels) in numbered(
        folder, (("a.jpg", 3), ("a.png", 3), ("a.png", 4), ("a.png", 1), ("a.jpg", 1))
    ):
        write_image(seed / name, noise[..., :channels], quality=60)
        (seed / name).rename(seed / "image")  # what it is must be told from its bytes
        yield seed


def made_with_profiles(folder):
    for seed, icc in numbered(folder, SPACES.values()):
        Image.fromarray(COLOURS).save(seed / "image", "WEBP", lossless=True, icc_profile=icc)
        yield seed


def made_decoded(write, name, *photos):
    def make(folder):
        for seed, arguments in numbered(folder, photos):
            write(seed / name, *arguments)
            yield seed

    return make


def decoded(name):
    def read(folder):
        data = read_metadata(folder / name)
        assert read_image(folder / name).shape == (data.height, data.width, 3)
        finite(data.latitude, data.longitude, data.altitude, data.focal_pixels)

    return read


LIGHT = np.tile(COLOURS / 255.0, (2, 2, 1))  # LibRaw refuses smaller ones
HEICS = ((COLOURS,), (np.dstack([COLOURS, COLOURS[..., 0]]), 6), (COLOURS[..., 0], 3))
DNGS = ((LIGHT,), (LIGHT, (0.4, 1.0, 0.6), 6), (LIGHT, (0.5, 1.0, 0.8), 3, b"RO"))


def read_pixels(folder):
    width, height = image_size(folder / "image")
    pixels = read_image(folder / "image")
    assert pixels.shape == (height, width, 3) and pixels.dtype == np.uint8
    assert read_image((folder / "image").read_bytes(), (8, 6)).shape == (6, 8, 3)
