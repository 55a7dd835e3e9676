"""Colours of photos in another profile than sRGB's, converted by LittleCMS, which Pillow has."""

import functools
import io
import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray

SAME = 2  # of 255, the most by which a profile of sRGB moves a colour, as programs write it
STEPS = range(0, 256, 51)


@functools.lru_cache(16)  # photos of a set have few profiles
def to_srgb(profile: bytes) -> Any:
    """The conversion of colours in a profile to sRGB, for `converted`; None if that changes none.

    ValueError if the profile is damaged or not one of red, green and blue.
    """
    from PIL import ImageCms

    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        found = ImageCms.buildTransform(
            source, ImageCms.createProfile("sRGB"), "RGB", "RGB", ImageCms.Intent.RELATIVE_COLORIMETRIC
        )
    except (OSError, ImageCms.PyCMSError):
        raise ValueError("a damaged profile, or one of other channels") from None
    colours = np.array([list(itertools.product(STEPS, repeat=3))], np.uint8)
    moved = np.abs(converted(colours, found).astype(int) - colours).max()
    return found if moved > SAME else None


def converted(pixels: NDArray[np.uint8], conversion: Any) -> NDArray[np.uint8]:
    """Colours uint8[H, W, 3] after a conversion of `to_srgb`; those beyond sRGB are clipped."""
    from PIL import Image, ImageCms

    image = Image.fromarray(np.ascontiguousarray(pixels))
    return np.asarray(ImageCms.applyTransform(image, conversion))
