"""Locks on folders. A lock ends with its process, however that process ends."""

import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from clsplat.errors import InputError

LOCK = ".lock"  # a native lock of the operating system; on Linux the one of `flock FOLDER/.lock`
HOLDER = ".lock.txt"  # its process, for messages only; a killed process leaves it behind


class LockTaken(InputError):
    """Another process has locked the folder."""


@contextmanager
def exclusive(folder: Path, patience: float = 0.0) -> Iterator[None]:
    """Lock an existing folder while the block runs.

    The same thread of the same process may lock a folder again. The lock of a process that has
    died is free at once, whatever files it left.

    Parameters
    ----------
    patience : seconds to wait for a process that has locked it.

    Raises
    ------
    LockTaken : the folder is still locked by another process, which the message names.
    InputError : the folder cannot be written, or its file system has no locks.
    """
    if not os.path.isdir(folder):
        raise InputError(f"{folder}: cannot be locked (no such folder); check its path")
    path = Path(os.path.realpath(folder)) / LOCK
    lock = FileLock(path, is_singleton=True)
    try:
        lock.acquire(timeout=patience)
    except Timeout:
        raise LockTaken(f"{folder}: {_holder(folder)} works here; wait for it, or stop it") from None
    except (OSError, NotImplementedError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(
            f"{path}: cannot be locked ({reason}); check that the folder exists and "
            "may be written, and that its file system has locks (Lustre: -o flock)"
        ) from None
    try:
        if lock.lock_counter == 1:
            words = f"process {os.getpid()} on {socket.gethostname()}, since {time.strftime('%Y-%m-%d %H:%M:%S')},"
            with suppress(OSError):  # a full disk must not keep a lock from being taken
                path.with_name(HOLDER).write_text(words, "utf-8")
        yield
    finally:
        if lock.lock_counter == 1:
            with suppress(OSError):
                path.with_name(HOLDER).unlink(missing_ok=True)
        lock.release()


def check_unlocked(folder: Path) -> None:
    """LockTaken if another process has locked the folder at this moment; nothing is written."""
    if (Path(folder) / LOCK).is_file():
        with exclusive(folder):
            pass


def _holder(folder: Path) -> str:
    """Which process has locked a folder, in words, as far as it is known."""
    with suppress(OSError, ValueError):
        return (Path(folder) / HOLDER).read_text("utf-8") or "another process"
    return "another process"
