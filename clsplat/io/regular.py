"""Regular files, not folders, devices, or pipes that may never end; and bounds for those that hold
more than their size: zip, gzip, textures and references to one place.

What a header claims is compared with the size of the file before anything is read, and no read goes
beyond the claim: a decompressor that is asked for all there is gives whatever a bomb holds.
"""

import errno
import io
import os
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

# what a file holds unpacked may have this many times its size, plus a share for small files; a
# bomb has more
LARGEST_EXPANSION, FREE_BYTES = 100, 1 << 26
VALUES = 14  # of a gaussian, without harmonics above the constant
# other methods of a zip are decompressed without a limit
METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


def open_regular(path: str | Path) -> io.BufferedReader:
    """Open a regular file for reading in binary; OSError for a folder, a device or a pipe."""
    os.stat(path)  # raises an error if there is nothing
    if not os.path.isfile(path):
        raise OSError(errno.EINVAL, "it is a folder, a pipe or a device, not a file")
    return open(path, "rb")


def read_regular(path: str | Path) -> bytes:
    """The bytes of a regular file; OSError as from `open_regular`."""
    with open_regular(path) as file:
        return file.read()


def check_expansion(size: int, claimed: int) -> None:
    """ValueError if a file of some bytes claims to hold too many when it is unpacked."""
    if claimed > FREE_BYTES + LARGEST_EXPANSION * size:
        raise ValueError(f"its {size} bytes claim to hold {claimed}")


def check_rows(size: int, count: int, bands: int) -> None:
    """As `check_expansion`, for `count` gaussians in double precision with `bands` harmonics above
    the constant, which textures and streams of a few bytes may hold by the million."""
    check_expansion(size, 8 * count * (VALUES + 3 * bands))


@contextmanager
def opened_archive(
    path: Path, wanted: Callable[[str], bool] = lambda name: True
) -> Iterator[tuple[zipfile.ZipFile, dict[str, zipfile.ZipInfo]]]:
    """A zip file and those of its members, by name, that are wanted.

    ValueError if these claim too much, or are packed by a method without a limit; other errors are
    those of `open_regular` and any that zipfile raises. A stream of a member gives at most as many
    bytes as the member claims, and compares its CRC at their end.
    """
    with open_regular(path) as file, zipfile.ZipFile(file) as archive:
        members = {
            member.filename: member for member in archive.infolist() if not member.is_dir() and wanted(member.filename)
        }
        check_expansion(file.seek(0, io.SEEK_END), sum(member.file_size for member in members.values()))
        if any(member.compress_type not in METHODS for member in members.values()):
            raise ValueError("it is compressed by another method than deflate")
        yield archive, members
