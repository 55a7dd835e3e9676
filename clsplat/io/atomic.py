"""Files that are never half written."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import BufferedWriter
from os import PathLike
from pathlib import Path

from clsplat.errors import InputError

PARTIAL = ".part"
DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextmanager
def replacing(path: str | PathLike[str], synced: bool = True) -> Iterator[BufferedWriter]:
    """Open a binary file beside `path` that replaces it when the block ends.

    If anything fails, the old file stays as it was, the new one is removed, and a full disk or a
    folder that may not be written raises InputError. `synced` : wait until the disk has it; else it
    survives the end of the process, but that of the machine soon after may leave a shorter one.
    """
    path = Path(path)
    partial = path.with_name(path.name + PARTIAL)
    try:
        if path.is_dir():  # which would be found only when all is written
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        partial.unlink(missing_ok=True)  # of a killed process; a link would be followed
        with open(partial, "wb") as file:
            yield file
            file.flush()
            if synced:
                os.fsync(file.fileno())
        os.replace(partial, path)
    except BaseException as error:
        with suppress(OSError):  # the folder is missing or read-only: so is the file
            partial.unlink(missing_ok=True)
        cause = _system_error(error) if isinstance(error, Exception) else None
        if cause is None:
            raise
        cure = (
            "free some space and try again (a training: with --resume)"
            if cause.errno in DISK_FULL
            else "check that the folder exists and may be written"
        )
        raise InputError(f"{path}: cannot be written ({cause.strerror}); {cure}") from error


def _system_error(error: BaseException | None) -> OSError | None:
    """The OSError behind an exception, or None: zipfile raises its own error when it closes."""
    while error is not None:
        if isinstance(error, OSError) and error.strerror:
            return error
        error = error.__context__
    return None
