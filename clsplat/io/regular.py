"""Regular files: folders, devices, and pipes that may never end, are refused."""

import errno
import os
import stat
from io import BufferedReader
from pathlib import Path

# to open a pipe without a writer would wait for one
FLAGS = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
KINDS = {stat.S_IFDIR: "a folder", stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket"}


def open_regular(path: str | Path) -> BufferedReader:
    """Open a regular file for reading in binary; OSError for a folder, a device or a pipe."""
    number = os.open(path, FLAGS)
    try:
        kind = stat.S_IFMT(os.fstat(number).st_mode)
        if kind != stat.S_IFREG:
            raise OSError(errno.EINVAL, f"it is {KINDS.get(kind, 'a device')}, not a file")
        return os.fdopen(number, "rb")
    except BaseException:
        os.close(number)
        raise


def read_regular(path: str | Path) -> bytes:
    """The bytes of a regular file; OSError as from `open_regular`."""
    with open_regular(path) as file:
        return file.read()
