"""Photos in and renders out, through OpenImageIO."""

import os
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from clsplat.errors import InputError
from clsplat.io.atomic import replacing
from clsplat.io.photo import opened, reason_of
from clsplat.io.resample import resample_bands

JPEG_QUALITY = 92
STREAMED, PIPES = ("png", "jpeg"), "/dev/fd"  # formats written in one go; Linux and macOS


def write_image(path, pixels, quality=JPEG_QUALITY):
    """Write pixels uint8[H, W, 3], or float[H, W, 3] in 0..1 (clipped; NaN is black), as sRGB.

    The suffix of `path` selects the format; quality: of JPEG, 1 to 100. The file appears whole,
    read back and compared, or not at all. Raises InputError where it cannot be written.
    """
    path = Path(path)
    data = encode_image(pixels, path.suffix.lower().removeprefix("."), quality, path)
    with replacing(path, data) as file:
        file.write(data)


def encode_jpeg(pixels, quality):
    """The bytes of the JPEG that `write_image` would write."""
    return encode_image(pixels, "jpg", quality, "JPEG")


def encode_image(pixels: np.ndarray, suffix: str, quality: int, name: object) -> bytes:
    """The bytes of an image file.

    Its writers know only files, and report success on a full disk or, as libjpeg does, end the
    process. So they write into a pipe where there is one, else into a temporary file.

    Parameters
    ----------
    pixels : uint8[H, W, 3], or float[H, W, 3] in 0..1 (clipped; NaN is black), sRGB.
    suffix : of the format, such as "png".
    quality : of JPEG, 1 to 100.
    name : of the image, for messages.

    Raises
    ------
    InputError : the format is unknown, or its writer fails.
    """
    import OpenImageIO as oiio

    if pixels.dtype != np.uint8:
        pixels = (np.clip(np.nan_to_num(pixels), 0, 1) * 255 + 0.5).astype(np.uint8)
    height, width, channels = pixels.shape
    output = oiio.ImageOutput.create(suffix)
    if output is None:
        oiio.geterror()  # the library keeps it, and warns at exit, until somebody asks
        raise InputError(f"{name}: not an image format that can be written; use .png or .jpg")
    spec = oiio.ImageSpec(width, height, channels, oiio.UINT8)
    if output.format_name() == "jpeg":
        spec.attribute("Compression", f"jpeg:{quality}")
        spec.attribute("jpeg:subsampling", "4:4:4")

    def write(path):
        written = output.open(path, spec) and output.write_image(np.ascontiguousarray(pixels))
        if not (output.close() and written):
            raise InputError(f"{name}: cannot be encoded ({reason_of(output)})")

    if output.format_name() in STREAMED and Path(PIPES).is_dir():
        return _piped(write)
    with tempfile.TemporaryDirectory(prefix="clsplat-") as folder:
        path = Path(folder) / f"image.{suffix}"
        write(str(path))
        return path.read_bytes()


def _piped(write):
    """All bytes that write(path) writes into the path that it is given.

    Both ends are in threads, which Ctrl-C does not reach: a reader that went away would make
    libjpeg end the process.
    """
    receiver, sender = os.pipe()

    def fill():
        try:
            write(f"{PIPES}/{sender}")
        finally:
            os.close(sender)  # or the other end would read for ever

    def drain():
        with open(receiver, "rb") as file:
            return file.read()

    with ThreadPoolExecutor(2) as threads:
        content, filled = threads.submit(drain), threads.submit(fill)
        filled.result()
        return content.result()


def read_image(source, size=None, window=None):
    """uint8[H, W, 3] of a photo: a Path, or the encoded bytes of one.

    Grey is widened to three channels, alpha dropped, deeper samples rounded to 8 bits, linear light
    brought to sRGB. window: (left, top, right, bottom), pixels, the part to read; None: all; size:
    (width, height), pixels, to which that is resampled by area. Raises InputError for a file that
    is missing, cut short or no image, or whose colours cannot be read.
    """
    with opened(source) as photo:
        left, top, right, bottom = window or (0, 0, photo.width, photo.height)
        old = right - left, bottom - top
        bands = (band[:, left:right] for band in photo.bands(top, bottom))
        if size is not None and size != old:
            return resample_bands(bands, old, size)
        pixels, row = np.empty((old[1], old[0], 3), np.uint8), 0
        for band in bands:
            pixels[row:row + len(band)] = band
            row += len(band)
        return pixels


def read_photo(view):
    """uint8[H, W, 3]: a view's photo, or the part of it that its camera shows, at its camera's
    size; errors as `read_image`."""
    camera = view.camera
    size = camera.width, camera.height
    if camera.whole is None:
        return read_image(view.source, size)
    low, high = np.reshape(camera.whole, (2, 2))
    scale = image_size(view.source) / (high - low)
    window = [np.rint((end - low) * scale).astype(int) for end in (np.zeros(2), np.array(size))]
    return read_image(view.source, size, np.concatenate(window).tolist())


def image_size(source):
    """(width, height) in pixels of a photo, from its header only; errors as `read_image`."""
    with opened(source) as photo:
        return photo.width, photo.height
