"""Colours in Display P3 and Adobe RGB become sRGB; all others stay what they are."""

import io
import struct
from dataclasses import replace

import numpy as np
import pytest
import tifffile
from PIL import Image, ImageCms

from clsplat.io.models import sog
from clsplat.io.photos.images import read_image
from clsplat.io.photos.photo import opened
from clsplat.io.scenes.read import read_scene
from clsplat.io.scenes.sources import checked_photos
from tests.data.tiny_model import write_scene

# the colours of red, green and blue, adapted to D50, as the makers' own profiles have them
P3 = ((0.51512, 0.2412, -0.00105), (0.29198, 0.69225, 0.04189), (0.1571, 0.06657, 0.78407))
ADOBE = ((0.60974, 0.31111, 0.01947), (0.20528, 0.62567, 0.06087), (0.14919, 0.06322, 0.74457))
SRGB = ((0.43607, 0.22249, 0.01392), (0.38515, 0.71687, 0.09708), (0.14307, 0.06061, 0.7141))
OF_SRGB, OF_ADOBE = (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045), (2 + 51 / 256, 1, 0, 1, 0)
# linear light of these spaces in linear sRGB, by CSS Color 4 and by Adobe's and IEC's primaries
TO_SRGB = {
    "P3": [[1.2249402, -0.2249402, 0], [-0.0420570, 1.0420570, 0], [-0.0196376, -0.0786361, 1.0982736]],
    "Adobe": [[1.3983557, -0.3983557, 0], [0, 1, 0], [0, -0.0429290, 1.0429290]],
}


def profile(primaries, curve, white=(0.9642, 1, 0.82491)):
    """An ICC profile with a matrix, and curves y = (a x + b)^g, or c x below d."""

    def fixed(*values):
        return struct.pack(f">{len(values)}i", *(round(value * 65536) for value in values))

    curves = b"para" + struct.pack(">IHH", 0, 3, 0) + fixed(*curve)
    tags = {
        b"wtpt": b"XYZ \0\0\0\0" + fixed(*white),
        b"desc": b"desc" + struct.pack(">II", 0, 2) + b"a" + bytes(79),
        b"cprt": b"text\0\0\0\0none\0",
    }
    for letter, colour in zip(b"rgb", primaries):
        tags[bytes([letter]) + b"XYZ"] = b"XYZ \0\0\0\0" + fixed(*colour)
        tags[bytes([letter]) + b"TRC"] = curves
    table, body = struct.pack(">I", len(tags)), b""
    for name, content in tags.items():
        table += name + struct.pack(">II", 132 + 12 * len(tags) + len(body), len(content))
        body += content + bytes(-len(content) % 4)
    head = bytearray(128)
    head[8:24] = struct.pack(">I", 0x04300000) + b"mntrRGB XYZ "
    head[36:40], head[68:80] = b"acsp", fixed(0.9642, 1, 0.82491)
    data = bytes(head) + table + body
    return struct.pack(">I", len(data)) + data[4:]


SPACES = {"P3": profile(P3, OF_SRGB), "Adobe": profile(ADOBE, OF_ADOBE)}
COLOURS = np.random.default_rng(0).integers(60, 190, (16, 24, 3), dtype=np.uint8)


def expected(space):
    """The colours in sRGB, by formulas in float64."""
    x, (power, a, b, c, d) = COLOURS / 255, OF_SRGB if space == "P3" else OF_ADOBE
    light = np.where(x < d, c * x, (a * x + b) ** power) @ np.transpose(TO_SRGB[space])
    light = np.clip(light, 0, 1)
    return 255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def save(path, pixels, icc):
    """Write a photo of 8 or, as TIFF, of 16 bits with a profile."""
    if path.suffix == ".tif":
        tifffile.imwrite(
            path,
            pixels.astype(np.uint16) * 257,
            iccprofile=icc,
            photometric="rgb" if pixels.ndim == 3 else "minisblack",
        )
    else:
        Image.fromarray(pixels).save(path, icc_profile=icc, lossless=True)
    return path


@pytest.mark.parametrize("suffix", ["png", "webp", "tif"])
@pytest.mark.parametrize("space", SPACES)
def test_colours_become_srgb(tmp_path, space, suffix):
    path = save(tmp_path / f"a.{suffix}", COLOURS, SPACES[space])
    found = read_image(path)
    assert np.abs(found - expected(space)).max() <= 1.01
    assert np.abs(found.astype(int) - COLOURS).max() > 10
    assert np.array_equal(read_image(path.read_bytes()), found)


def test_what_srgb_lacks_is_clipped_and_grey_stays(tmp_path):
    pixels = np.array([[[255, 0, 0], [255, 255, 255], [0, 0, 0]]], np.uint8)
    found = read_image(save(tmp_path / "a.png", pixels, SPACES["P3"]))
    assert found.tolist() == pixels.tolist()


@pytest.mark.parametrize(
    "icc",
    [
        None,
        ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes(),
        profile(SRGB, OF_SRGB),
        profile(SRGB, OF_SRGB, (0.95045, 1, 1.08905)),
    ],
)
def test_srgb_and_no_profile_change_no_byte(tmp_path, icc):
    """Also where the profile names D65 as its white, as those of cameras do."""
    path = save(tmp_path / "a.png", COLOURS, icc)
    assert np.array_equal(read_image(path), COLOURS)
    with opened(path) as photo:
        assert photo.to_srgb is None and not photo.has_unused_profile


LAB = ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB")).tobytes()


@pytest.mark.parametrize(
    "suffix, pixels, icc",
    [
        ("tif", COLOURS[..., 0], SPACES["P3"]),
        ("webp", COLOURS, LAB),
        ("tif", COLOURS, LAB),
        ("webp", COLOURS, SPACES["P3"][:200]),
        ("webp", COLOURS, SPACES["P3"][:36] + b"none" + SPACES["P3"][40:]),
    ],
)
def test_profiles_that_do_not_fit_are_left_out(tmp_path, suffix, pixels, icc):
    path = save(tmp_path / f"a.{suffix}", pixels, icc)
    assert np.array_equal(read_image(path), pixels if pixels.ndim == 3 else np.repeat(pixels[..., None], 3, 2))
    with opened(path) as photo:
        assert photo.to_srgb is None and photo.has_unused_profile


def test_a_scene_says_so_once(tmp_path):
    scene = read_scene(write_scene(tmp_path / "town"))
    for view, icc in zip(scene.views, (SPACES["P3"], SPACES["Adobe"], LAB)):
        image = Image.open(view.source)
        image.load()
        image.save(view.source, "WEBP", icc_profile=icc)
    notes = [note for note in checked_photos(replace(scene, notes=())).notes if "profile" in note]
    assert len(notes) == 2 and notes[0].startswith("2 of 4 photos have colours in another profile")
    assert notes[1].startswith("1 of 4 photos have a colour profile that is damaged")


def test_textures_of_models_are_numbers(tmp_path):
    file = io.BytesIO()
    rgba = np.dstack([COLOURS, np.full(COLOURS.shape[:2], 255, np.uint8)])
    Image.fromarray(rgba).save(file, "WEBP", lossless=True, icc_profile=SPACES["P3"])
    assert np.array_equal(sog._decoded(file.getvalue()), rgba)
