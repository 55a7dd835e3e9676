"""Regular files of any name: devices, and pipes that may never end, are refused.

OpenImageIO needs names in UTF-8 and does not read Python's memory. A file with another name, or
one in memory, is passed to it by the number of an open file.
"""

import errno
import os
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path

from clsplat.errors import InputError

DESCRIPTORS = ("/proc/self/fd", "/dev/fd")  # where Linux and macOS show open files
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


def native(name: str) -> str:
    """The name of a scene's file as Python needs it on this machine: under a locale without UTF-8
    Python refuses names that are not ASCII."""
    return os.fsdecode(str(name).encode(errors="surrogatepass"))


def in_unicode(path: Path) -> str:
    """The name from which `native` made a relative path."""
    return os.fsencode(path.as_posix()).decode(errors="replace")


@contextmanager
def utf8_path(path: str | Path) -> Iterator[str]:
    """Yield a name in UTF-8 for a file, which OpenImageIO needs."""
    try:
        name = os.fsencode(path).decode()
    except UnicodeDecodeError:
        with open_regular(path) as file:
            yield _by_number(path, file.fileno())
        return
    yield name


@contextmanager
def memory_file(name: str, content: bytes) -> Iterator[str]:
    """Yield the path of a file in memory, or of a temporary file where the system has none;
    InputError, with this name of the content, if there is no space for it."""
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


def _temporary(name: str) -> tuple[int, str]:
    try:
        return tempfile.mkstemp(prefix="clsplat-")
    except OSError as error:
        raise InputError(_no_space(name, error, error.filename)) from None


def _write(number: int, content: bytes) -> None:
    rest = memoryview(content)
    while rest:
        rest = rest[os.write(number, rest):]


def _no_space(name: str, error: OSError, path: str | None) -> str:
    where = f"the temporary folder {tempfile.gettempdir()}" if path else "a file in memory"
    cure = ("raise the limit of file sizes (ulimit -f)" if error.errno == errno.EFBIG else
            "free some space there, or let TMPDIR name another folder" if path else
            "free some memory")
    return f"{name}: cannot be copied into {where} ({error.strerror}); {cure}"


def _by_number(name: str | Path, number: int) -> str:
    for folder in DESCRIPTORS:
        if Path(folder).is_dir():
            return f"{folder}/{number}"
    raise InputError(f"{name}: its name is not UTF-8; rename it")
