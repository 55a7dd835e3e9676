"""Decoded photos of a level that wait on the host: a few in memory, the others in a file.

A photo is decoded once a level, and not again at each of its uses: a photo of 50 megapixels takes
about a second to decode, and a twentieth of that to read from such a file.
"""

import shutil
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from io import BufferedRandom
from pathlib import Path
from threading import Lock

import numpy as np
from numpy.typing import NDArray

MEMORY_BYTES = 128 << 20  # of the photos that a store keeps in memory
DISK_SHARE = 0.25  # of the free space of the disk, which its file may take
Kept = NDArray[np.uint8] | tuple[int, ...] | None  # the photo, its shape in the file, or nothing


class PhotoStore:
    """Decodes photos in threads, from the first to the last, and keeps them.

    The file has no name, so the system removes it however the process ends. Photos for which there
    is neither memory nor space are decoded at each use.

    Parameters
    ----------
    sizes : bytes of each photo, or more.
    decode : called with a photo's index; returns it, uint8[channels, H, W].
    threads : that decode.
    folder : of the file; None: the system's folder for temporary files.

    Attributes
    ----------
    count : how many photos are kept, which are the first.
    """

    def __init__(self, sizes: Sequence[int], decode: Callable[[int], NDArray[np.uint8]],
                 threads: int, folder: Path | None = None) -> None:
        ends = np.cumsum(sizes)
        self._decode, self._in_memory = decode, int((ends <= MEMORY_BYTES).sum())
        self.count, self._lock = self._in_memory, Lock()
        self._file: BufferedRandom | None = None
        self._begins = (ends - sizes - ends[self._in_memory - 1] * (self._in_memory > 0)).tolist()
        if self._in_memory < len(sizes):
            self._open_file(folder or Path(tempfile.gettempdir()), np.append(
                self._begins[self._in_memory + 1:], self._begins[-1] + sizes[-1]))
        self._threads = ThreadPoolExecutor(threads)
        self._photos: list[Future[Kept]] = [
            self._threads.submit(self._keep, i) for i in range(self.count)]

    def _open_file(self, folder: Path, ends: NDArray[np.int64]) -> None:
        try:
            fits = int((ends <= DISK_SHARE * shutil.disk_usage(folder).free).sum())
            if fits:
                self._file = tempfile.TemporaryFile(dir=folder)
                self.count += fits
        except OSError:
            pass  # a folder that cannot be written

    def _keep(self, index: int) -> Kept:
        photo = self._decode(index)
        if index < self._in_memory:
            return photo
        try:
            with self._lock:
                assert self._file is not None
                self._file.seek(self._begins[index])
                self._file.write(photo.data)
        except (OSError, ValueError):  # the disk is full, or the store closed
            return None
        return photo.shape

    def wait(self) -> None:
        """Wait until all photos that are kept are decoded; InputError at a damaged one."""
        for photo in self._photos:
            photo.result()

    def read(self, index: int) -> NDArray[np.uint8]:
        """A photo, as `decode` returns it, once it is decoded; its errors."""
        kept = self._photos[index].result() if index < self.count else None
        if isinstance(kept, np.ndarray):
            return kept
        if kept is not None:
            photo = np.empty(kept, np.uint8)
            with self._lock:
                assert self._file is not None
                self._file.seek(self._begins[index])
                if self._file.readinto(photo.data) == photo.nbytes:
                    return photo
        return self._decode(index)

    def close(self) -> None:
        """Drop all photos, and remove the file."""
        self._threads.shutdown(wait=False, cancel_futures=True)
        self._photos = []
        self.count = 0
        with self._lock:
            if self._file is not None:
                self._file.close()
