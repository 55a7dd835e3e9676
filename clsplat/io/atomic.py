"""Files that are never half written."""

import errno
import os
from contextlib import contextmanager
from pathlib import Path

from clsplat.errors import InputError

PARTIAL = ".part"
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextmanager
def replacing(path, content=None):
    """A binary file beside `path` that takes its place, on disk, when the block ends.

    Whatever goes wrong, the old file stays as it was and the new one is removed; a disk that is
    full or may not be written raises InputError. content: the bytes that the file must hold then,
    as read back; None checks its size only.
    """
    path = Path(path)
    partial = path.with_name(path.name + PARTIAL)
    try:
        _remove(partial)  # what a killed process left; were it a link, it would be followed
        with open(partial, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
            size = file.seek(0, os.SEEK_END)
        if partial.stat().st_size != size or content not in (None, partial.read_bytes()):
            raise OSError(errno.EIO, "what was written cannot be read back")
        os.replace(partial, path)
    except BaseException as error:
        _remove(partial)
        cause = _system_error(error) if isinstance(error, Exception) else None
        if cause is None:
            raise
        cure = ("free some space and try again (a training: with --resume)"
                if cause.errno in FULL else "check that the folder exists and may be written")
        raise InputError(f"{path}: cannot be written ({cause.strerror}); {cure}") from error


def _remove(path):
    try:
        path.unlink(missing_ok=True)
    except OSError:
        pass  # the folder is missing or read-only: so is the file


def _system_error(error):
    """The OSError behind an exception, or None: zipfile hides it behind its own when it closes."""
    while error is not None and not (isinstance(error, OSError) and error.strerror):
        error = error.__context__
    return error
