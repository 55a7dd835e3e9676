"""LPIPS (Zhang et al. 2018) by a network that the user gives as an ONNX file."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.errors import InputError
from clsplat.io.reason import reason

EXPORT = "export it from the lpips package with torch.onnx.export"


class Lpips:
    """Compares two images by a network; lower is better.

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
            raise InputError(f"--lpips {self.path}: needs onnxruntime; install it with "
                             "`pip install onnxruntime`") from None
        if not self.path.is_file():
            raise InputError(f"{self.path}: no such file; give the ONNX file of an LPIPS "
                             "network, or leave --lpips out")
        settings = onnxruntime.SessionOptions()
        settings.log_severity_level = 4  # what goes wrong is raised, too
        try:
            self._session = onnxruntime.InferenceSession(
                str(self.path), settings, providers=["CPUExecutionProvider"])
        except Exception as error:  # noqa: BLE001  (onnxruntime has a class for each kind)
            raise InputError(f"{self.path}: not a network that onnxruntime can read "
                             f"({reason(error)}); {EXPORT}") from None
        self._inputs = [given.name for given in self._session.get_inputs()]
        if len(self._inputs) != 2:
            raise InputError(f"{self.path}: has {len(self._inputs)} inputs, where LPIPS compares "
                             f"two images; {EXPORT}")

    def __call__(self, image: ArrayLike, photo: ArrayLike,
                 valid: NDArray[np.bool_] | None = None) -> float:
        """LPIPS of two images.

        Parameters
        ----------
        image, photo : float[H, W, 3], 0 to 1.
        valid : bool[H, W], the pixels that count; the others are those of the photo in both
            images, as a network looks at more than a pixel. None: all.

        Raises
        ------
        InputError : the network takes images of another size, or does not give one number.
        """
        if valid is not None:
            image = np.where(valid[..., None], image, photo)
        tensors = (_tensor(image), _tensor(photo))
        try:
            results: list[Any] = self._session.run(None, dict(zip(self._inputs, tensors)))
        except Exception as error:  # noqa: BLE001
            height, width = tensors[0].shape[2:]
            raise InputError(f"{self.path}: cannot compare images of {width}x{height} pixels "
                             f"({reason(error)}); export it with dynamic axes for height and "
                             "width") from None
        if np.size(results[0]) != 1:
            raise InputError(f"{self.path}: gives {np.size(results[0])} numbers, not one; {EXPORT}")
        return float(np.reshape(results[0], ()))


def _tensor(image: ArrayLike) -> NDArray[np.float32]:
    """[1, 3, H, W], -1 to 1."""
    pixels = np.asarray(image, np.float32).transpose(2, 0, 1)[None]
    return np.ascontiguousarray(2 * pixels - 1)
