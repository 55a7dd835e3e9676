"""Photos as other programs write them, and as nobody should: read right, or refused in one line.

docs/guide/photos.md promises what is asserted here. `PICTURE` is what every readable case shows.
"""

import os
import struct
import zlib

import numpy as np
import OpenImageIO as oiio
import pytest
import tifffile
from PIL import Image

from clsplat.io.photos import resample
from clsplat.io.photos.images import image_bands, read_image
from clsplat.io.photos.photo import opened
from tests.refusals import refused

Y, X = np.mgrid[:24, :32]
PICTURE = np.stack([X * 8, Y * 10, (X + Y) * 4], axis=2).astype(np.uint8)
GREY = np.repeat(PICTURE[..., :1], 3, axis=2)
ALPHA = np.where(X < 16, 0, 255).astype(np.uint8)[..., None]
TURN = 0x0112  # EXIF's orientation


def pillow(mode="RGB", array=PICTURE, **options):
    return lambda path: Image.fromarray(array).convert(mode).save(path, **options)


def tiff(array=PICTURE, photometric="rgb", **options):
    return lambda path: tifffile.imwrite(path, array, photometric=photometric, **options)


def library(array, kind):
    """By OpenImageIO, which writes what Pillow does not."""

    def write(path):
        spec = oiio.ImageSpec(array.shape[1], array.shape[0], array.shape[2], kind)
        output = oiio.ImageOutput.create(str(path))
        if output is None:
            pytest.skip(f"this OpenImageIO writes no {path.suffix}: {oiio.geterror()}")
        assert output.open(str(path), spec) and output.write_image(array) and output.close()

    return write


def under_another_suffix(suffix, write):
    def renamed(path):
        write(path.with_suffix(suffix))
        path.with_suffix(suffix).rename(path)

    return renamed


def exif(number):
    tags = Image.Exif()
    tags[TURN] = number
    return tags


def twelve_bits(path):
    """Netpbm says itself how far its samples reach."""
    path.write_bytes(b"P6 32 24 4095\n" + (PICTURE.astype(float) / 255 * 4095).round().astype(">u2").tobytes())


PALETTE = Image.fromarray(PICTURE).quantize(256)
FEW = np.asarray(PALETTE.convert("RGB"))
ONE_BIT = np.repeat((PICTURE[..., :1] > 127) * np.uint8(255), 3, axis=2)
BIG = np.tile(PICTURE, (4, 4, 1))

# name -> (file name, writes it, what it shows, grey levels it may be off on average)
READ = {
    "progressive": ("a.jpg", pillow(quality=95, progressive=True, subsampling=0), PICTURE, 1.5),
    "CMYK JPEG": ("a.jpg", pillow("CMYK", quality=95), PICTURE, 2),
    "grey JPEG": ("a.jpg", pillow(array=PICTURE[..., 0], mode="L", quality=95), GREY, 1.5),
    "PNG called JPEG": ("a.jpg", under_another_suffix(".png", pillow()), PICTURE, 0),
    "1-bit PNG": ("a.png", pillow("1", (PICTURE[..., 0] > 127) * np.uint8(255)), ONE_BIT, 0),
    "palette with transparency": ("a.png", lambda p: PALETTE.save(p, transparency=3), FEW, 0),
    "grey with alpha": (
        "a.png",
        lambda p: Image.fromarray(np.dstack([PICTURE[..., :1], ALPHA]), "LA").save(p),
        GREY,
        0,
    ),
    "alpha PNG": ("a.png", pillow("RGBA", np.dstack([PICTURE, ALPHA])), PICTURE, 0),
    "16-bit PNG": ("a.png", library(PICTURE.astype(np.uint16) * 257, "uint16"), PICTURE, 0),
    "EXIF turned": ("a.jpg", pillow(quality=95, subsampling=0, exif=exif(6)), PICTURE, 1.5),
    "TIFF in strips": ("a.tif", tiff(BIG, rowsperstrip=7), BIG, 0),
    "tiled planar TIFF": ("a.tif", tiff(BIG.transpose(2, 0, 1), planarconfig="separate", tile=(32, 48)), BIG, 0),
    "TIFF of pages": ("a.tif", tiff(np.stack([PICTURE, 255 - PICTURE])), PICTURE, 0),
    "white is zero": ("a.tif", tiff(255 - PICTURE[..., 0], "miniswhite"), GREY, 0),
    "five channels": ("a.tif", tiff(np.dstack([PICTURE, PICTURE[..., :2]]), planarconfig="contig"), PICTURE, 0),
    "netpbm of 12 bits": ("a.ppm", twelve_bits, PICTURE, 0.5),
    "animated GIF": ("a.gif", lambda p: PALETTE.save(p, save_all=True, append_images=[PALETTE.rotate(180)]), FEW, 0),
}


@pytest.mark.parametrize("case", READ)
def test_read_right(tmp_path, monkeypatch, case):
    """From a file and from memory, at once and in bands."""
    name, write, expected, levels = READ[case]
    write(tmp_path / name)
    pixels = read_image(tmp_path / name)
    assert pixels.shape == expected.shape
    assert np.abs(pixels.astype(int) - expected).mean() <= levels
    assert np.array_equal(read_image((tmp_path / name).read_bytes()), pixels)
    monkeypatch.setattr(resample, "BAND_BYTES", 700)
    assert np.array_equal(read_image(tmp_path / name), pixels)
    height, width = pixels.shape[:2]
    part = image_bands(tmp_path / name, (width - 5, height - 6), (3, 5, width - 2, height - 1))
    assert np.array_equal(np.concatenate(list(part)), pixels[5:-1, 3:-2])


def damaged(write, change):
    def spoil(path):
        write(path)
        path.write_bytes(change(path.read_bytes()))

    return spoil


def claims(width, height):
    """A PNG that has the bytes of a small one."""

    def change(data):
        head = data[12:16] + struct.pack(">II", width, height) + data[24:29]
        return data[:12] + head + struct.pack(">I", zlib.crc32(head)) + data[33:]

    return damaged(pillow(), change)


def cut(write, share):
    return damaged(write, lambda data: data[: int(len(data) * share)])


def tiff_claims(tag, value):
    """One entry of a TIFF's directory, changed in place."""

    def change(data):
        data = bytearray(data)
        begin = struct.unpack_from("<I", data, 4)[0]
        for entry in range(struct.unpack_from("<H", data, begin)[0]):
            place = begin + 2 + 12 * entry
            if struct.unpack_from("<H", data, place)[0] == tag:
                struct.pack_into("<HII", data, place + 2, 4, 1, value)
        return bytes(data)

    return damaged(tiff(), change)


NOISE = np.random.default_rng(0).integers(0, 256, (64, 96, 3), dtype=np.uint8)
FLOATS = PICTURE.astype(np.float32) / 255

# name -> (file name, writes it, words of the line)
REFUSED = {
    "nothing": ("a.jpg", lambda p: None, ("no such file",)),
    "text": ("a.jpg", lambda p: p.write_text("hello"), ("not an image", "convert it")),
    "a folder": ("a.png", lambda p: p.mkdir(), ("a folder",)),
    "a pipe": ("a.png", os.mkfifo if hasattr(os, "mkfifo") else None, ("a pipe",)),
    "a device": ("a.png", (lambda p: p.symlink_to("/dev/zero")) if os.name != "nt" else None, ("a device",)),
    "null format": ("a.null", lambda p: p.write_bytes(b"x"), ("null are not read",)),
    "DPX": ("a.dpx", library(PICTURE, "uint8"), ("format dpx", "convert it")),
    "PNG of 60000 x 60000": ("a.png", claims(60000, 60000), ("a.png", ";")),
    "PNG taller than its data": ("a.png", claims(32, 48), ("damaged or cut short",)),
    "PNG bit flipped": (
        "a.png",
        damaged(library(NOISE, "uint8"), lambda d: d[:4000] + bytes([d[4000] ^ 255]) + d[4001:]),
        ("damaged or cut short",),
    ),
    "progressive JPEG cut": ("a.jpg", cut(pillow(array=NOISE, progressive=True), 0.7), ("cut short",)),
    "TIFF of 2^31 rows": ("a.tif", tiff_claims(257, 2**31 - 1), ("a.tif", ";")),
    "Lab TIFF": ("a.tif", tiff(photometric="cielab"), ("CIELAB", "convert it to RGB")),
    "EXR": ("a.exr", library(FLOATS, "float"), ("floating point", "convert it")),
    "float TIFF": ("a.tif", tiff(FLOATS), ("floating point", "convert it")),
    "TIFF in LZMA": ("a.tif", tiff(compression="lzma"), ("LZMA", "convert it")),
    "netpbm of huge size": ("a.ppm", lambda p: p.write_bytes(b"P6 99999999 99999999 255\n"), ("a.ppm", ";")),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_in_one_line(tmp_path, case):
    name, write, words = REFUSED[case]
    if write is None:
        pytest.skip("this system has no pipes with names")
    write(tmp_path / name)
    line = refused(lambda: read_image(tmp_path / name), ";", *words)
    assert line.startswith(str(tmp_path / name))


def test_what_a_header_says(tmp_path):
    found = {}
    for case in ("alpha PNG", "EXIF turned", "five channels", "palette with transparency"):
        name, write, _, _ = READ[case]
        write(tmp_path / name)
        with opened(tmp_path / name) as photo:
            found[case] = photo.has_alpha, photo.orientation, photo.extra
    assert found == {
        "alpha PNG": (True, 1, 0),
        "EXIF turned": (False, 6, 0),
        "five channels": (False, 1, 2),
        "palette with transparency": (True, 1, 0),
    }
