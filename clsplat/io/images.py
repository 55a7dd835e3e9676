"""Photos in and renders out, through OpenImageIO."""

from pathlib import Path

import numpy as np

from clsplat.errors import InputError
from clsplat.io.photo import opened, reason_of
from clsplat.io.regular import memory_file
from clsplat.io.resample import resample_bands

JPEG_QUALITY = 92


def write_image(path, pixels, quality=JPEG_QUALITY):
    """Write pixels uint8[H, W, 3], or float[H, W, 3] in 0..1 (clipped; NaN is black), as sRGB.

    The suffix of `path` selects the format; quality: of JPEG, 1 to 100. Raises InputError where
    the file cannot be written.
    """
    import OpenImageIO as oiio

    if pixels.dtype != np.uint8:
        pixels = (np.clip(np.nan_to_num(pixels), 0, 1) * 255 + 0.5).astype(np.uint8)
    height, width, channels = pixels.shape
    output = oiio.ImageOutput.create(str(path))
    if output is None:
        oiio.geterror()  # the library keeps it, and warns at exit, until somebody asks
        raise InputError(f"{path}: not an image format that can be written; use .png or .jpg")
    spec = oiio.ImageSpec(width, height, channels, oiio.UINT8)
    if output.format_name() == "jpeg":
        spec.attribute("Compression", f"jpeg:{quality}")
        spec.attribute("jpeg:subsampling", "4:4:4")
    written = output.open(str(path), spec) and output.write_image(np.ascontiguousarray(pixels))
    if not (output.close() and written):
        raise InputError(f"{path}: cannot be written ({reason_of(output)}); "
                         "check that the folder exists, may be written and has space")


def encode_jpeg(pixels, quality):
    """The bytes of the JPEG that `write_image` would write, of uint8[H, W, 3]."""
    import OpenImageIO as oiio

    name = "a JPEG in memory"
    output = oiio.ImageOutput.create("jpeg")
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], oiio.UINT8)
    spec.attribute("Compression", f"jpeg:{quality}")
    spec.attribute("jpeg:subsampling", "4:4:4")
    with memory_file(name) as path:
        written = output.open(path, spec) and output.write_image(np.ascontiguousarray(pixels))
        if not (output.close() and written):
            raise InputError(f"{name}: cannot be written ({reason_of(output)}); free some memory")
        return Path(path).read_bytes()


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
