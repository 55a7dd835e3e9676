"""Locks on folders that end with the process that holds them, however it ends."""

import errno
import fcntl
import os
import socket
import time
from contextlib import contextmanager
from pathlib import Path

from clsplat.errors import InputError

LOCK = ".lock"  # as `flock FOLDER/.lock` of a shell takes it
WAIT_SECONDS = 0.2


class Held(InputError):
    """Another process holds the folder."""


@contextmanager
def exclusive(folder, patience=0.0):
    """Hold a folder alone; Held if another process still does after `patience` seconds."""
    path = Path(folder) / LOCK
    try:
        file = open(path, "a+")
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); check that the folder "
                         "exists and may be written") from None
    with file:
        deadline = time.monotonic() + patience
        while not _taken(file, path):
            if time.monotonic() >= deadline:
                file.seek(0)
                raise Held(f"{folder}: {file.read().strip() or 'another process'} works here; wait "
                           "for it, or stop it")
            time.sleep(WAIT_SECONDS)
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
        file.flush()
        try:
            yield
        finally:
            file.truncate(0)


def _taken(file, path):
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EAGAIN, errno.EACCES):
            return False
        raise InputError(f"{path}: this file system has no locks ({error.strerror}); mount it with "
                         "them (Lustre: -o flock), or use another") from None
    return True
