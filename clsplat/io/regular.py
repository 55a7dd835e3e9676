"""Regular files: folders, devices, and pipes that may never end, are refused."""

import errno
import os
from io import BufferedReader
from pathlib import Path


def open_regular(path: str | Path) -> BufferedReader:
    """Open a regular file for reading in binary; OSError for a folder, a device or a pipe."""
    os.stat(path)  # raises an error if there is nothing
    if not os.path.isfile(path):
        raise OSError(errno.EINVAL, "it is a folder, a pipe or a device, not a file")
    return open(path, "rb")


def read_regular(path: str | Path) -> bytes:
    """The bytes of a regular file; OSError as from `open_regular`."""
    with open_regular(path) as file:
        return file.read()
