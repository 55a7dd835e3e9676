"""PSNR, SSIM, FLIP and LPIPS of a render against its photo, or against the pixels of it that count,
and the colour fit, by which exposure does not count as error.

Images are float[H, W, 3], 0 to 1, sRGB; `valid` is bool[H, W], the pixels that count, at least one;
None: all.
"""

from __future__ import annotations

from functools import cache
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike, NDArray

from clsplat.errors import InputError, reason

Valid = NDArray[np.bool_] | None
SSIM_WINDOW, SSIM_SIGMA = 11, 1.5  # pixels
SIDE = SSIM_WINDOW // 2  # of a window, beside its middle
TILE, STRIP = 16, 256  # pixels: a product smooths so many; rows at a time, which stay in the cache
# of a monitor 0.7 m wide with 3840 pixels, seen from 0.7 m: the default of Andersson et al. (2020)
PIXELS_PER_DEGREE = 67.02
# of which features are made together; few calls, as threads that score other views wait for each
CHUNK_PIXELS = 1 << 14
EXPORT = "export it from the lpips package with torch.onnx.export"


def psnr(image: ArrayLike, photo: ArrayLike, valid: Valid = None) -> float:
    """Peak signal-to-noise ratio, dB, over all pixels and channels; inf for equal images."""
    errors = _float64(photo) - _float64(image)
    if valid is not None:
        errors = errors[valid]
    with np.errstate(divide="ignore"):
        return float(-10 * np.log10(np.mean(errors**2)))


def ssim(image: ArrayLike, photo: ArrayLike, valid: Valid = None) -> float:
    """Structural similarity of Wang et al. (2004), -1 to 1: the mean of its map.

    The window is a gaussian of sigma 1.5, truncated to 11x11; K1 = 0.01, K2 = 0.03, population
    covariance, mean of the RGB channels. Pixels whose window would leave the image (a border of 5)
    do not count; the training loss and 3DGS's script pad with zeros instead. With a mask, only
    pixels do whose whole window counts, or if there are none, all that count themselves.
    InputError if the images are smaller than the window.
    """
    height, width = np.shape(image)[:2]
    if min(height, width) < SSIM_WINDOW:
        raise InputError(
            f"an image of {width}x{height} pixels is smaller than the {SSIM_WINDOW}x{SSIM_WINDOW} "
            "window of SSIM; use larger photos, by a smaller --downscale or a larger "
            "--max-resolution"
        )
    counted: Any = slice(SIDE, -SIDE), slice(SIDE, -SIDE)
    if valid is not None:
        whole = scipy.ndimage.minimum_filter(valid, SSIM_WINDOW, mode="constant", cval=0)
        counted = whole if whole.any() else valid
        # 0 where no such window reads: a product multiplies what lies beyond by 0, also a nan
        read = scipy.ndimage.maximum_filter(counted, SSIM_WINDOW)[:, :, None]
        image, photo = np.where(read, image, 0), np.where(read, photo, 0)
    channels = zip(np.moveaxis(np.asarray(image), 2, 0), np.moveaxis(np.asarray(photo), 2, 0))
    return float(np.mean([_ssim_map(_float64(x), _float64(y))[counted].mean() for x, y in channels]))


def _ssim_map(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """The SSIM of one channel at every pixel, [H, W], whose borders are mirrored."""
    (height, width), sides = x.shape, [(SIDE, SIDE + -size % TILE) for size in x.shape]
    x, y = np.pad(x, sides, "symmetric"), np.pad(y, sides, "symmetric")
    strips = [slice(top, top + STRIP + 2 * SIDE) for top in range(0, height, STRIP)]
    return np.concatenate([_similarity(x[strip], y[strip]) for strip in strips])[:height, :width]


def _similarity(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """The SSIM of whole windows of a strip."""
    mean_x, mean_y, covariance, variances = _means(np.stack([x, y, x * y, x * x + y * y]))
    product, squares = mean_x * mean_y, mean_x * mean_x + mean_y * mean_y
    covariance -= product
    variances -= squares
    return np.asarray((2 * product + 1e-4) * (2 * covariance + 9e-4) / ((squares + 1e-4) * (variances + 9e-4)))


def _means(planes: NDArray[np.float64]) -> NDArray[np.float64]:
    """The weighted means of all whole windows of planes [planes, rows, columns], a tile at a time:
    products with a band matrix take a fifth of the time of a correlation. Along columns it is one
    product, as BLAS lets threads wait for each other at the begin of each."""
    reach, count = TILE + 2 * SIDE, len(planes)
    rows = _band() @ sliding_window_view(planes, reach, axis=1)[:, ::TILE].swapaxes(2, 3)
    windows = sliding_window_view(rows, reach, axis=3)[:, :, :, ::TILE]
    height, width = windows.shape[1] * TILE, windows.shape[3] * TILE
    return np.asarray((windows.reshape(-1, reach) @ _band().T).reshape(count, height, width))


@cache
def _band() -> NDArray[np.float64]:
    """[TILE, TILE + 2 SIDE]: in each row the weights of a window, one pixel further."""
    away = np.arange(TILE + 2 * SIDE) - SIDE - np.arange(TILE)[:, None]
    weights = np.where(abs(away) <= SIDE, np.exp(-0.5 * (away / SSIM_SIGMA) ** 2), 0.0)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


def _float64(image: ArrayLike) -> NDArray[np.float64]:
    return np.asarray(image, np.float64)


def flip(image: ArrayLike, photo: ArrayLike, valid: Valid = None) -> float:
    """FLIP of Andersson et al. (2020) for images of limited range, at PIXELS_PER_DEGREE: the mean,
    from 0 (no difference is visible to a person) to 1. Pixels that do not count are taken as equal.
    """
    import OpenImageIO as oiio

    def linear(image: ArrayLike) -> Any:
        buffer = oiio.ImageBuf(np.ascontiguousarray(image, np.float32))
        buffer.specmod().attribute("oiio:ColorSpace", "sRGB")  # which the library converts
        return buffer

    shown = image if valid is None else np.where(valid[..., None], image, photo)
    difference = oiio.ImageBufAlgo.FLIP_diff(
        linear(photo), linear(shown), hdr=0, ppd=PIXELS_PER_DEGREE, nthreads=1
    )  # a view a thread
    pixels = difference.get_pixels()
    if difference.has_error or pixels is None:
        raise RuntimeError(difference.geterror())
    error = pixels[..., 0]
    return float(error[... if valid is None else valid].mean(dtype=np.float64))


class Lpips:
    """LPIPS (Zhang et al. 2018) by a network that the user gives; lower is better.

    Parameters
    ----------
    path : an ONNX file with two inputs float32[1, 3, H, W], -1 to 1, RGB, and one output of a
        single number, such as torch.onnx.export makes of `lpips.LPIPS`.

    Raises
    ------
    InputError : the file is missing or is not such a network, or onnxruntime is not installed.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        self.path = Path(path)
        try:
            import onnxruntime
        except ImportError:
            raise InputError(
                f"--lpips {self.path}: needs onnxruntime; install it with `pip install onnxruntime`"
            ) from None
        if not self.path.is_file():
            raise InputError(f"{self.path}: no such file; give the ONNX file of an LPIPS network, or leave --lpips out")
        settings = onnxruntime.SessionOptions()
        settings.log_severity_level = 4  # what goes wrong is raised, too
        try:
            self._session = onnxruntime.InferenceSession(str(self.path), settings, providers=["CPUExecutionProvider"])
        except Exception as error:  # noqa: BLE001  (onnxruntime has a class for each kind)
            raise InputError(
                f"{self.path}: not a network that onnxruntime can read ({reason(error)}); {EXPORT}"
            ) from None

    def __call__(self, image: ArrayLike, photo: ArrayLike, valid: Valid = None) -> float:
        """LPIPS of two images; InputError if the network does not give one number for them.

        Pixels that do not count are those of the photo in both: a network looks at more than one.
        """
        if valid is not None:
            image = np.where(valid[..., None], image, photo)
        tensors = [
            np.ascontiguousarray(2 * np.asarray(each, np.float32).transpose(2, 0, 1)[None] - 1)
            for each in (image, photo)
        ]
        inputs = [given.name for given in self._session.get_inputs()]
        try:
            result = self._session.run(None, dict(zip(inputs, tensors, strict=True)))[0]
            return float(np.reshape(result, ()))
        except Exception as error:  # noqa: BLE001
            height, width = tensors[0].shape[2:]
            raise InputError(
                f"{self.path}: cannot compare images of {width}x{height} pixels "
                f"({reason(error)}); {EXPORT}, with two images as inputs, dynamic "
                "axes for height and width, and one number as output"
            ) from None


def fit_colour(image: ArrayLike, photo: ArrayLike, valid: Valid = None) -> NDArray[np.float64]:
    """`image` under the quadratic colour map that brings it closest to `photo`, clipped to 0 to 1.

    Each output channel is a weighted sum of the six products of two channels, the three channels
    and 1. The weights are the least-squares solution over all pixels that count, and the smallest
    one if the pixels do not determine it (a constant or grey image).
    """
    pixels, target = _float64(image).reshape(-1, 3).T.copy(), _float64(photo).reshape(-1, 3)
    kept = slice(None) if valid is None else np.flatnonzero(valid)
    fitting, target = pixels[:, kept], target[kept]
    gram, moment, room = np.zeros((10, 10)), np.zeros((10, 3)), np.ones((10, CHUNK_PIXELS))
    for begin in range(0, len(target), CHUNK_PIXELS):
        features = _features(fitting[:, begin : begin + CHUNK_PIXELS], room)
        # unlike `@` where the result is small, `dot` lets other threads go on
        gram += np.dot(features, features.T)
        moment += np.dot(features, target[begin : begin + CHUNK_PIXELS])
    # the sums are accurate to about 1e-14 of the largest: smaller singular values are rounding
    weights = np.linalg.lstsq(gram, moment, rcond=1e-13)[0]
    fitted = np.empty(pixels.shape[::-1])
    for begin in range(0, len(fitted), CHUNK_PIXELS):
        end = begin + CHUNK_PIXELS
        fitted[begin:end] = _features(pixels[:, begin:end], room).T @ weights
    return fitted.clip(0.0, 1.0, out=fitted).reshape(np.shape(image))


def _features(pixels: NDArray[np.float64], room: NDArray[np.float64]) -> NDArray[np.float64]:
    """[10, N]: the features of colours [3, N], in an array [10, at least N] whose last row is 1."""
    features = room[:, : pixels.shape[1]]
    np.multiply(pixels, pixels, out=features[:3])
    np.multiply(pixels[:2], pixels[1:], out=features[3:5])
    np.multiply(pixels[2], pixels[0], out=features[5])
    features[6:9] = pixels
    return features
