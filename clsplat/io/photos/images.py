"""Photos in and renders out, through OpenImageIO."""

import shutil
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.io.atomic import replacing
from clsplat.io.photos.photo import Levels, Source, opened, reason_of
from clsplat.io.photos.resample import joined, resampled_bands

JPEG_QUALITY = 92
Attributes = Mapping[str, str | int | float | tuple[float, ...]]  # of OpenImageIO, by name
SPARE_BYTES = 1 << 20  # of the disk, beside twice the pixels of an image


def write_image(
    path: str | Path, pixels: NDArray[Any], quality: int = JPEG_QUALITY, attributes: Attributes = MappingProxyType({})
) -> None:
    """Write an image file, which appears whole or not at all.

    Parameters
    ----------
    path : its suffix selects the format.
    pixels : uint8[H, W, 3], or float[H, W, 3] in 0..1 (clipped; NaN is black), sRGB.
    quality : of JPEG, 1 to 100.
    attributes : as for `encode_image`.
    """
    path = Path(path)
    data = encode_image(pixels, path.suffix.lower().removeprefix("."), quality, path, attributes)
    with replacing(path) as file:
        file.write(data)


def eight_bits(pixels: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Numbers in 0..1 rounded to uint8; others are clipped, NaN becomes 0."""
    scaled: NDArray[np.floating] = np.clip(np.nan_to_num(pixels), 0, 1) * 255 + 0.5
    return scaled.astype(np.uint8)


def encode_image(
    pixels: NDArray[Any], suffix: str, quality: int, name: object, attributes: Attributes = MappingProxyType({})
) -> bytes:
    """Encode an image as the bytes of a file.

    OpenImageIO writes to files only, and on a full disk it reports success or, in libjpeg, ends the
    process. So the space for its temporary file is checked before.

    Parameters
    ----------
    pixels, quality : as for `write_image`.
    suffix, name : of the format, such as "png", and of the image for messages.
    attributes : further ones of OpenImageIO for this format, such as those of EXIF; a tuple is
        float32[N].
    """
    import OpenImageIO as oiio

    if pixels.dtype != np.uint8:
        pixels = eight_bits(pixels)
    height, width, channels = pixels.shape
    output = oiio.ImageOutput.create(suffix)
    if output is None:
        oiio.geterror()  # else the library warns at exit that nobody read its error
        raise InputError(f"{name}: not an image format that can be written; use .png or .jpg")
    spec = oiio.ImageSpec(width, height, channels, oiio.UINT8)
    if output.format_name() == "jpeg":
        spec.attribute("Compression", f"jpeg:{quality}")
        spec.attribute("jpeg:subsampling", "4:4:4")
    for attribute, value in attributes.items():
        if isinstance(value, tuple):
            spec.attribute(attribute, oiio.TypeDesc(f"float[{len(value)}]"), value)
        else:
            spec.attribute(attribute, value)

    with tempfile.TemporaryDirectory(prefix="clsplat-") as folder:
        if shutil.disk_usage(folder).free < 2 * pixels.nbytes + SPARE_BYTES:
            raise InputError(
                f"{name}: the folder for temporary files, {tempfile.gettempdir()}, is "
                "nearly full; free some space there, or let TMPDIR name another one"
            )
        path = Path(folder) / f"image.{suffix}"
        written = output.open(str(path), spec) and output.write_image(np.ascontiguousarray(pixels))
        if not (output.close() and written):
            raise InputError(f"{name}: cannot be encoded ({reason_of(output)})")
        return path.read_bytes()


def read_image(source: Source, size: tuple[int, int] | None = None, levels: Levels | None = None) -> NDArray[np.uint8]:
    """Read a photo as uint8[H, W, 3], sRGB.

    Grey becomes three equal channels, alpha is dropped, deeper samples are rounded to 8 bits, and
    linear light is converted to sRGB.

    Parameters
    ----------
    source : a path, the encoded bytes of a photo, or an array, as `photo.opened` takes them.
    size : (width, height), pixels, to which the image is resampled by area averaging.
    levels : the samples of 16 bits that become black and white.
    """
    size = size or image_size(source)
    return joined(image_bands(source, size, levels=levels), size)


def image_bands(
    source: Source, size: tuple[int, int], window: tuple[int, int, int, int] | None = None, levels: Levels | None = None
) -> Iterator[NDArray[np.uint8]]:
    """Yield what `read_image` reads from the top down, uint8[n, W, 3] each, or of a window (left,
    top, right, bottom) in pixels; where the format allows, no more than a few rows of the photo are
    in memory at once."""
    with opened(source) as photo:
        photo.levels = levels
        left, top, right, bottom = window or (0, 0, photo.width, photo.height)
        old = right - left, bottom - top
        bands = (band[:, left:right] for band in photo.bands(top, bottom))
        yield from bands if size == old else resampled_bands(bands, old, size)


def window_of(camera: Camera, size: tuple[int, int]) -> tuple[int, int, int, int]:
    """(left, top, right, bottom): the part of the whole photo that a camera shows, pixels of a
    photo of this size (width, height)."""
    low, high = np.reshape(camera.borders, (2, 2))
    scale = np.array(size) / (high - low)
    left, top = np.rint((np.zeros(2) - low) * scale).astype(int).tolist()
    right, bottom = np.rint(([camera.width, camera.height] - low) * scale).astype(int).tolist()
    return left, top, right, bottom


def read_alpha(source: Source) -> NDArray[np.uint8]:
    """Read the alpha channel of a photo as it is stored, uint8[H, W]."""
    with opened(source) as photo:
        return photo.alpha()


def image_size(source: Source) -> tuple[int, int]:
    """(width, height) of a photo in pixels, from its header only; errors as in `read_image`."""
    with opened(source) as photo:
        return photo.width, photo.height
