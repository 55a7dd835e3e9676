"""Files that are read, and nothing else: no device, no pipe that never ends, and any name.

OpenImageIO takes names as UTF-8 and reads no memory from Python. What has no such name, or lies in
memory, it is given by the number of an open file.
"""

import errno
import os
import stat
import tempfile
from contextlib import contextmanager
from pathlib import Path

from clsplat.errors import InputError

DESCRIPTORS = ("/proc/self/fd", "/dev/fd")  # where Linux and macOS show open files
NO_WAIT = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)  # a pipe without a writer waits


def open_regular(path):
    """A regular file, opened for reading in binary; OSError for a folder, a device or a pipe."""
    number = os.open(path, os.O_RDONLY | NO_WAIT)
    try:
        mode = os.fstat(number).st_mode
        if not stat.S_ISREG(mode):
            raise OSError(errno.EINVAL, f"it is {_kind(mode)}, not a file")
        return os.fdopen(number, "rb")
    except BaseException:
        os.close(number)
        raise


def read_regular(path):
    """The bytes of a regular file; OSError as `open_regular`."""
    with open_regular(path) as file:
        return file.read()


def _kind(mode):
    kinds = {stat.S_IFDIR: "a folder", stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket"}
    return kinds.get(stat.S_IFMT(mode), "a device")


def native(name):
    """A name of a scene, str, as the file system of this machine has it: under a locale without
    UTF-8 Python would refuse other names than those of ASCII."""
    return os.fsdecode(str(name).encode(errors="surrogatepass"))


@contextmanager
def utf8_path(path):
    """A name of the file `path` that is UTF-8, as OpenImageIO wants it."""
    try:
        yield os.fsencode(path).decode()
        return
    except UnicodeDecodeError:
        pass
    with open_regular(path) as file:
        yield _by_number(path, file.fileno())


@contextmanager
def memory_file(name, content=b""):
    """The path of a file in memory, or where the system has none, a temporary one, that holds
    `content`; InputError, naming `name`, where there is no space for it."""
    path = None
    if hasattr(os, "memfd_create"):
        number = os.memfd_create("clsplat")
    else:
        number, path = _temporary(name)
    try:
        try:
            _write(number, content)
        except OSError as error:
            raise InputError(_no_space(name, error, path)) from None
        yield path or _by_number(name, number)
    finally:
        os.close(number)
        if path is not None:
            os.unlink(path)


def _temporary(name):
    try:
        return tempfile.mkstemp(prefix="clsplat-")
    except OSError as error:
        raise InputError(_no_space(name, error, error.filename)) from None


def _write(number, content):
    rest = memoryview(content)
    while rest:
        rest = rest[os.write(number, rest):]


def _no_space(name, error, path):
    where = f"the temporary folder {tempfile.gettempdir()}" if path else "a file in memory"
    cure = ("raise the limit of file sizes (ulimit -f)" if error.errno == errno.EFBIG else
            "free some space there, or let TMPDIR name another folder" if path else
            "free some memory")
    return f"{name}: {where} does not take it ({error.strerror}); {cure}"


def _by_number(name, number):
    for folder in DESCRIPTORS:
        if Path(folder).is_dir():
            return f"{folder}/{number}"
    raise InputError(f"{name}: its name is not UTF-8; rename it")
