"""Kernels that PoCL has compiled, for all of pytest's workers.

PoCL's cache is not safe across processes, so that each worker has one of its own; what one worker
compiled, the others get by links, when they begin and between two files of tests. A file of the
cache is whole when it is there, since PoCL renames it into place. Intel's runtime needs none of
this: `clsplat/device/programs.py`.
"""

import os
import time
from contextlib import suppress
from pathlib import Path

FOLDER = Path.home() / ".cache" / "clsplat-tests"
SECONDS = 20  # between two exchanges of a worker
OVERLAP = 60 * 10**9  # ns; what another worker was giving during the last exchange


class SharedKernels:
    """The cache of one worker, which PoCL uses from now on, and the one that all share."""

    def __init__(self, worker, folder=FOLDER):
        self.own, self.shared, self._looked = folder / worker, folder / "shared", 0.0
        self._stamp = self.own / "exchanged"  # whose time is of the same clock as the programs'
        self.own.mkdir(parents=True, exist_ok=True)
        os.environ["POCL_CACHE_DIR"] = str(self.own)

    def exchange(self, at_once=False):
        """Give and take the programs that have changed since the last time; at once all of them."""
        if at_once or time.monotonic() - self._looked > SECONDS:
            since = self._stamp.stat().st_mtime_ns - OVERLAP if self._stamp.exists() else 0
            self._stamp.touch()
            link_missing(self.own, self.shared, 0 if at_once else since)
            link_missing(self.shared, self.own, since)
            self._looked = time.monotonic()


def changed(cache, since):
    """The programs of a cache, which lie two folders deep, that have got a kernel since then."""
    for folder in filter(Path.is_dir, Path(cache).glob("*")):
        with os.scandir(folder) as programs:
            yield from (each.path for each in programs if each.stat().st_mtime_ns >= since)


def link_missing(source, target, since):
    """Hard links in `target` to all files below `source` that it lacks."""
    for program in changed(source, since):
        for folder, _, names in os.walk(program):
            place = Path(target, os.path.relpath(folder, source))
            if names:
                place.mkdir(parents=True, exist_ok=True)
            for name in set(names).difference(os.listdir(place) if names else ()):
                with suppress(FileExistsError, FileNotFoundError):  # another worker was faster
                    os.link(os.path.join(folder, name), place / name)
