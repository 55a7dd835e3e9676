"""Lossless WebP with four channels of any bytes, not pictures, through OpenImageIO."""

import numpy as np
from numpy.typing import NDArray

from clsplat.io.photos.images import encode_image
from clsplat.io.photos.photo import reason_of, temporary_file
from clsplat.io.unpack import check_expansion


def encode_webp(pixels: NDArray[np.uint8]) -> bytes:
    """The bytes of a WebP file of pixels uint8[H, W, 4].

    They come back as they are, except that the colours of a pixel with a last channel of 0 may
    become 0.
    """
    return encode_image(pixels, "webp", 100, "WebP", {
        "compression": "lossless:50", "webp:method": 3, "oiio:UnassociatedAlpha": 1})


def decode_webp(data: bytes) -> NDArray[np.uint8]:
    """The pixels uint8[H, W, 4] of a WebP file; ValueError if it is damaged or too large."""
    import OpenImageIO as oiio

    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)  # as stored, not multiplied by the last channel
    with temporary_file(data) as path:
        image = oiio.ImageInput.open(path, config)
        reason = reason_of(oiio)
        if image is None or image.format_name() != "webp":
            raise ValueError(f"a texture is no WebP {reason}")
        try:
            spec = image.spec()
            check_expansion(len(data), spec.width * spec.height * 4)
            pixels = image.read_image("uint8")
            reason = reason_of(image)
        finally:
            image.close()
    if pixels is None or reason:
        raise ValueError(f"a texture is damaged: {reason}")
    if pixels.shape[2] == 3:  # an encoder may leave out a last channel of 255
        pixels = np.concatenate([pixels, np.full((*pixels.shape[:2], 1), 255, np.uint8)], axis=2)
    return pixels
