"""Regular files: folders, devices, and pipes that may never end, are refused."""

import errno
import os
import stat
from io import BufferedReader
from pathlib import Path

# to open a pipe without a writer would wait for one
FLAGS = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)


def open_regular(path: str | Path) -> BufferedReader:
    """Open a regular file for reading in binary; OSError for a folder, a device or a pipe."""
    number = os.open(path, FLAGS)
    try:
        mode = os.fstat(number).st_mode
        if not stat.S_ISREG(mode):
            raise OSError(errno.EINVAL, f"it is {_kind(mode)}, not a file")
        return os.fdopen(number, "rb")
    except BaseException:
        os.close(number)
        raise


def read_regular(path: str | Path) -> bytes:
    """The bytes of a regular file; OSError as from `open_regular`."""
    with open_regular(path) as file:
        return file.read()


def _kind(mode: int) -> str:
    kinds = {stat.S_IFDIR: "a folder", stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket"}
    return kinds.get(stat.S_IFMT(mode), "a device")
