"""Frames of a video as photos: the sharpest of each of many equal windows of time.

It needs PyAV, an optional library.
"""

import os
import shutil
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from clsplat.errors import InputError, reason
from clsplat.io.folders import make_folder
from clsplat.io.photos.images import write_image
from clsplat.sfm.progress import Progress

try:
    import av
except ImportError:
    av = None  # type: ignore[assignment]

SHARPNESS_SIZE = 640  # long side in pixels at which sharpness is judged
QUALITY = 97  # of JPEG


def check_video(path: Path) -> None:
    """InputError if there is no such file, or no PyAV to read it with."""
    if av is None:
        raise InputError(f"{path}: to read videos needs PyAV, which is not installed; install it with `pip install av`")
    if not path.exists():
        raise InputError(f"{path}: no such file; check the path")


def extract_frames(path: Path, folder: Path, count: int, progress: Progress) -> None:
    """Write frames of a video as JPEG files into a new folder.

    Parameters
    ----------
    path : of a video that `check_video` has passed.
    folder : of the frames, of which there are `count` at most; another one there is removed.
    """
    shutil.rmtree(folder, ignore_errors=True)
    make_folder(folder)
    try:
        for number, frame in enumerate(_sharpest(path, count)):
            progress.count("taking sharp frame", number + 1, count)
            turns = round(getattr(frame, "rotation", 0) / 90)  # counter-clockwise, degrees
            write_image(folder / f"frame_{number:06d}.jpg", np.rot90(frame.to_ndarray(format="rgb24"), turns), QUALITY)
    except (av.FFmpegError, ValueError, IndexError) as error:
        raise InputError(f"{path}: not a video that can be decoded ({reason(error)}); convert it to MP4") from None


def _sharpest(path: Path, count: int) -> Iterator[Any]:
    """The sharpest frame of each of `count` windows."""
    with av.open(os.fspath(path)) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        total = stream.frames
        if not total and container.duration and stream.average_rate:
            total = int(container.duration / av.time_base * stream.average_rate)
        total = max(total, count)
        # a file may have more frames than its header claims
        for _, window in groupby(
            enumerate(container.decode(stream)), key=lambda numbered: min(numbered[0] * count // total, count - 1)
        ):
            yield max((frame for _, frame in window), key=_sharpness)


def _sharpness(frame: Any) -> float:
    """The variance of the Laplacian of a grey frame at a small size."""
    grey = frame.to_ndarray(format="gray")
    factor = min(1.0, SHARPNESS_SIZE / max(grey.shape))
    return float(scipy.ndimage.laplace(scipy.ndimage.zoom(grey.astype(np.float32), factor, order=1)).var())
