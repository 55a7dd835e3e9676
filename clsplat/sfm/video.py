"""Frames of a video as photos: the sharpest of each of many equal windows of time.

It needs PyAV, an optional library.
"""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import laplace, zoom

from clsplat.errors import InputError
from clsplat.io.folders import make_folder
from clsplat.io.photos.images import write_image
from clsplat.io.reason import reason
from clsplat.sfm.progress import Progress

try:
    import av
except ImportError:
    av = None  # type: ignore[assignment]

DONE = "frames.txt"
SHARPNESS_SIZE = 640  # long side in pixels at which sharpness is judged
QUALITY = 97  # of JPEG


def check_video(path: Path) -> None:
    """InputError if there is no such file, or no PyAV to read it with."""
    if av is None:
        raise InputError(f"{path}: to read videos needs PyAV, which is not installed; install it "
                         "with `pip install av`")
    if not path.exists():
        raise InputError(f"{path}: no such file; check the path")


def extract_frames(path: Path, folder: Path, count: int, progress: Progress) -> None:
    """Write frames of a video as JPEG files, unless an earlier call has done so.

    Parameters
    ----------
    path : of a video that `check_video` has passed.
    folder : of the frames, which is created.
    count : how many there shall be at most.

    Raises
    ------
    InputError : the file is not a video that PyAV can decode.
    """
    identity = f"{os.path.realpath(path)} {path.stat().st_size} {count}"
    marker = folder.with_name(DONE)
    if marker.exists() and marker.read_bytes() == identity.encode(errors="replace"):
        return
    marker.unlink(missing_ok=True)  # first: what it describes is no longer there
    make_folder(folder)
    for old in folder.iterdir():
        old.unlink()
    try:
        written = 0
        for frame in _sharpest(path, count, progress):
            write_image(folder / f"frame_{written:06d}.jpg", frame, QUALITY)
            written += 1
    except (av.FFmpegError, ValueError, IndexError) as error:
        raise InputError(f"{path}: not a video that can be decoded ({reason(error)}); convert it "
                         "to MP4") from None
    marker.write_bytes(identity.encode(errors="replace"))


def _sharpest(path: Path, count: int, progress: Progress) -> Iterator[NDArray[np.uint8]]:
    """The sharpest frame uint8[H, W, 3] of each of `count` windows."""
    with av.open(os.fspath(path)) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        total = stream.frames or _frames_by_time(container, stream) or count
        best: Any = None
        sharpest, window = -1.0, 0
        for index, frame in enumerate(container.decode(stream)):
            # a file may have more frames than its header claims
            current = min(index * count // max(total, count), count - 1)
            if current != window and best is not None:
                yield _upright(best)
                best, sharpest = None, -1.0
            window = current
            progress.count("looking for sharp frames, frame", min(index + 1, total), total)
            value = sharpness(frame.to_ndarray(format="gray"))
            if value > sharpest:
                best, sharpest = frame, value
        if best is not None:
            yield _upright(best)


def _frames_by_time(container: Any, stream: Any) -> int:
    """How many frames a video has by its duration; 0 if that is unknown."""
    if not container.duration or not stream.average_rate:
        return 0
    return int(container.duration / av.time_base * stream.average_rate)


def sharpness(grey: NDArray[Any]) -> float:
    """The variance of the Laplacian of an image [H, W] at a small size."""
    factor = min(1.0, SHARPNESS_SIZE / max(grey.shape))
    small = zoom(grey.astype(np.float32), factor, order=1) if factor < 1 else (
        grey.astype(np.float32))
    return float(laplace(small).var())


def _upright(frame: Any) -> NDArray[np.uint8]:
    """The pixels of a frame, turned by its metadata."""
    pixels = frame.to_ndarray(format="rgb24")
    turns = round(getattr(frame, "rotation", 0) / 90) % 4  # counter-clockwise, degrees
    return np.ascontiguousarray(np.rot90(pixels, turns))
