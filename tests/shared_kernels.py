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
SECONDS = 20  # between two exchanges of a worker: to look through a whole cache takes 0.3 s


class SharedKernels:
    """The cache of one worker, which PoCL uses from now on, and the one that all share."""

    def __init__(self, worker, folder=FOLDER):
        self.own, self.shared, self._looked = folder / worker, folder / "shared", 0.0
        self._seen = {}  # folder -> when it had last got a program
        self.own.mkdir(parents=True, exist_ok=True)
        os.environ["POCL_CACHE_DIR"] = str(self.own)

    def exchange(self, at_once=False):
        """Give and take what the other side lacks, if it may have got a program since."""
        if at_once or time.monotonic() - self._looked > SECONDS:
            for source, target in ((self.own, self.shared), (self.shared, self.own)):
                latest = changed(source)
                if at_once or latest != self._seen.get(source):
                    link_missing(source, target)
                    self._seen[source] = latest
            self._looked = time.monotonic()


def changed(cache):
    """When a program was last added to a cache, in which they lie two folders deep."""
    if not cache.is_dir():
        return 0
    with os.scandir(cache) as folders:
        return max([each.stat().st_mtime_ns for each in folders], default=0)


def link_missing(source, target):
    """Hard links in `target` to all files below `source` that it lacks."""
    for folder, _, names in os.walk(source):
        place = Path(target, os.path.relpath(folder, source))
        if names:
            place.mkdir(parents=True, exist_ok=True)
        for name in set(names).difference(os.listdir(place) if names else ()):
            with suppress(FileExistsError, FileNotFoundError):  # another worker was faster
                os.link(os.path.join(folder, name), place / name)
