"""Photos in and renders out, through OpenImageIO."""

import os
import tempfile
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from scipy.sparse import csr_matrix

from clsplat.errors import InputError
from clsplat.io.atomic import replacing

JPEG_QUALITY = 92
STREAMED, PIPES = ("png", "jpeg"), "/dev/fd"  # formats written in one go; Linux and macOS
# a header that claims more is damaged: no decoder may allocate for it
LARGEST_PIXELS = 1 << 30
PIXELS_PER_BYTE = 1 << 13  # deflate's limit, for samples of one bit


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
            raise InputError(f"{name}: cannot be encoded ({_reason(output)})")

    if output.format_name() in STREAMED and Path(PIPES).is_dir():
        return _piped(write)
    with tempfile.TemporaryDirectory(prefix="clsplat-") as folder:
        path = Path(folder) / f"image.{suffix}"
        write(str(path))
        return path.read_bytes()


def _piped(write):
    """All bytes that write(path) writes into the path that it is given."""
    receiver, sender = os.pipe()
    with ThreadPoolExecutor(1) as thread, open(receiver, "rb") as file:
        content = thread.submit(file.read)
        try:
            write(f"{PIPES}/{sender}")
        finally:
            os.close(sender)  # or the thread would read for ever
        return content.result()


def read_image(source, size=None):
    """uint8[H, W, 3] of a photo: a Path, or the encoded bytes of one.

    Grey is widened to three channels, alpha dropped, deeper samples rounded to 8 bits. size:
    (width, height), pixels; the photo is resampled to it by area. Raises InputError for a file
    that is missing, cut short or no image.
    """
    with _opened(source) as (image, name):
        channels = image.spec().nchannels
        pixels = image.read_image(0, 0, 0, channels, "uint8")
        # a JPEG cut short is filled with grey and only leaves a message behind
        reason = _reason(image)
    if pixels is None or reason:
        raise InputError(f"{name}: the image is damaged or cut short ({reason}); copy it again")
    pixels = pixels.reshape(*pixels.shape[:2], -1)
    pixels = pixels[..., :3] if channels >= 3 else np.repeat(pixels[..., :1], 3, axis=2)
    if size is not None and size != (pixels.shape[1], pixels.shape[0]):
        pixels = resample(pixels, size)
    return np.ascontiguousarray(pixels)


def read_photo(view):
    """uint8[H, W, 3]: a view's photo, or the part of it that its camera shows, at its camera's
    size; errors as `read_image`."""
    camera = view.camera
    size = camera.width, camera.height
    if camera.whole is None:
        return read_image(view.source, size)
    pixels = read_image(view.source)
    low, high = np.reshape(camera.whole, (2, 2))
    scale = (pixels.shape[1], pixels.shape[0]) / (high - low)
    (left, top), (right, bottom) = (np.rint((end - low) * scale).astype(int)
                                    for end in (np.zeros(2), np.array(size)))
    return resample(pixels[top:bottom, left:right], size)


def image_size(source):
    """(width, height) in pixels of a photo, from its header only; errors as `read_image`."""
    with _opened(source) as (image, _):
        return image.spec().width, image.spec().height


def resample(pixels, size):
    """`pixels`, uint8[H, W, 3], as uint8[height, width, 3]: each is the mean of the area it covers.

    size: (width, height). OpenImageIO's box filter is the same where the ratio is whole, but
    weighs every touched pixel fully where it is not, which shifts edges by a quarter pixel.
    """
    height, width = pixels.shape[:2]
    rows = _coverage(height, size[1]) @ pixels.reshape(height, -1).astype(np.float32)
    columns = rows.reshape(size[1], width, 3).transpose(1, 0, 2).reshape(width, -1)
    mean = (_coverage(width, size[0]) @ columns).reshape(size[0], size[1], 3)
    return (mean.transpose(1, 0, 2) + 0.5).astype(np.uint8)


def _coverage(old, new):
    """Sparse float32[new, old]: the share of new pixel i that old pixel j covers; rows sum to 1."""
    # in units of 1 / (old * new) every border is whole, so no rounding moves one
    borders = np.union1d(np.arange(old + 1) * new, np.arange(new + 1) * old)
    begins, lengths = borders[:-1], np.diff(borders)
    return csr_matrix(((lengths / old).astype(np.float32), (begins // old, begins // new)),
                      shape=(new, old))


@contextmanager
def _opened(source):
    """(ImageInput, name for messages) of an image; closed afterwards."""
    if not isinstance(source, bytes):
        with _opened_file(source, source) as image:
            yield image, source
        return
    # OpenImageIO reads memory in C++ only
    with tempfile.NamedTemporaryFile(prefix="clsplat-", suffix=".image") as file:
        file.write(source)
        file.flush()
        name = f"packed image of {len(source)} bytes"
        with _opened_file(file.name, name) as image:
            yield image, name


@contextmanager
def _opened_file(path, name):
    import OpenImageIO as oiio

    if not Path(path).is_file():
        raise InputError(f"{name}: no such image; check the path")
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)  # keep colours as stored, whatever their alpha
    image = oiio.ImageInput.open(str(path), config)
    reason = _reason(oiio)
    if image is None:
        raise InputError(f"{name}: not an image that can be read ({reason}); "
                         "copy it again, or convert it to JPEG or PNG")
    try:
        pixels = image.spec().width * image.spec().height
        if not 0 < pixels <= min(LARGEST_PIXELS, PIXELS_PER_BYTE * Path(path).stat().st_size):
            raise InputError(f"{name}: damaged: its header claims {image.spec().width}x"
                             f"{image.spec().height} pixels; copy it again")
        yield image
    finally:
        image.close()


def _reason(library):
    """The first line of what OpenImageIO last complained about, or an empty string."""
    return next(iter(library.geterror().splitlines()), "")
