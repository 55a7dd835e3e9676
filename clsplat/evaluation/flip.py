"""FLIP: how visible the differences between a render and its photo are to a person."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

# of a monitor 0.7 m wide with 3840 pixels, seen from 0.7 m: the default of Andersson et al. (2020)
PIXELS_PER_DEGREE = 67.02


def flip_map(image: ArrayLike, photo: ArrayLike) -> NDArray[np.float32]:
    """FLIP of Andersson et al. (2020) for images of limited range, at PIXELS_PER_DEGREE.

    Parameters
    ----------
    image, photo : float[H, W, 3], 0 to 1, sRGB.

    Returns
    -------
    [H, W], 0 (no visible difference) to 1.
    """
    import OpenImageIO as oiio

    difference = oiio.ImageBufAlgo.FLIP_diff(_srgb(oiio, photo), _srgb(oiio, image), hdr=0,
                                             ppd=PIXELS_PER_DEGREE)
    pixels = difference.get_pixels()
    if difference.has_error or pixels is None:
        raise RuntimeError(difference.geterror())
    error: NDArray[np.float32] = pixels[..., 0]
    return error


def flip(image: ArrayLike, photo: ArrayLike, valid: NDArray[np.bool_] | None = None) -> float:
    """The mean of `flip_map`: 0 to 1, lower is better.

    Parameters
    ----------
    image, photo : float[H, W, 3], 0 to 1, sRGB.
    valid : bool[H, W], the pixels that count, where others are taken as equal; None: all.
    """
    if valid is None:
        return float(flip_map(image, photo).mean(dtype=np.float64))
    shown = np.where(valid[..., None], image, photo)
    return float(flip_map(shown, photo)[valid].mean(dtype=np.float64))


def _srgb(oiio: Any, image: ArrayLike) -> Any:
    """An ImageBuf that the library converts to linear colours."""
    buffer = oiio.ImageBuf(np.ascontiguousarray(image, np.float32))
    buffer.specmod().attribute("oiio:ColorSpace", "sRGB")
    return buffer
