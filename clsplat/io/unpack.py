"""Bounds for files that hold more than their size: zip, gzip, textures and references to one place.

What a header claims is compared with the size of the file before anything is read, and no read goes
beyond the claim: a decompressor that is asked for all there is gives whatever a bomb holds.
"""

import io
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from clsplat.io.regular import open_regular

# what a file holds unpacked may have this many times its size, plus a share for small files; a
# bomb has more
LARGEST_EXPANSION, FREE_BYTES = 100, 1 << 26
VALUES = 14  # of a gaussian, without harmonics above the constant
# other methods of a zip are decompressed without a limit
METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


def check_expansion(size: int, claimed: int) -> None:
    """ValueError if a file of some bytes claims to hold too many when it is unpacked."""
    if claimed > FREE_BYTES + LARGEST_EXPANSION * size:
        raise ValueError(f"its {size} bytes claim to hold {claimed}")


def check_rows(size: int, count: int, bands: int) -> None:
    """As `check_expansion`, for gaussians in double precision, which textures and streams of a few
    bytes may hold by the million.

    Parameters
    ----------
    count, bands : gaussians, and harmonics above the constant of each.
    """
    check_expansion(size, 8 * count * (VALUES + 3 * bands))


class Bounded(io.BufferedIOBase):
    """A stream that is read only up to a size, which no single read exceeds either.

    Parameters
    ----------
    stream : what is read, from where it is.
    size : bytes that there are.
    """

    def __init__(self, stream: IO[bytes], size: int) -> None:
        self._stream, self._left, self._begin = stream, size, size

    def readable(self) -> bool:
        """It is only read."""
        return True

    def read(self, size: int | None = -1) -> bytes:
        """As of a file, but at most what is left."""
        size = self._left if size is None or size < 0 else min(size, self._left)
        content = self._stream.read(size)
        self._left -= len(content)
        return content

    def tell(self) -> int:
        """The bytes that were read."""
        return self._begin - self._left

    def check_end(self) -> None:
        """ValueError unless the stream ends here; a zip then compares its CRC."""
        if self._left or self._stream.read(1):
            raise ValueError("it holds more or less than its header claims")


class Archive:
    """The members of a zip file, by name; see `opened_archive`."""

    def __init__(self, archive: zipfile.ZipFile, size: int) -> None:
        self._archive, self._size = archive, size
        self.members = {member.filename: member for member in archive.infolist()
                        if not member.is_dir()}

    def check(self, names: Iterable[str]) -> None:
        """ValueError if these members claim too much, or are packed by a method without a limit."""
        members = [self.members[name] for name in names]
        check_expansion(self._size, sum(member.file_size for member in members))
        if any(member.compress_type not in METHODS for member in members):
            raise ValueError("it is compressed by another method than deflate")

    @contextmanager
    def opened(self, name: str) -> Iterator[Bounded]:
        """A stream of a member, which `Bounded.check_end` compares with its CRC."""
        member = self.members[name]
        with self._archive.open(member) as stream:
            yield Bounded(stream, member.file_size)

    def read(self, name: str) -> bytes:
        """The bytes of a member."""
        if name not in self.members:
            raise ValueError(f"it has no {name}")
        with self.opened(name) as stream:
            content = stream.read()
            stream.check_end()
            return content


class _WholeFile(io.BufferedReader):
    """A file that reads no more than its size: zipfile reads as much as a header claims, and Python
    allocates that much first."""

    def __init__(self, raw: io.RawIOBase) -> None:
        super().__init__(raw)
        self.size = self.seek(0, io.SEEK_END)

    def read(self, size: int | None = -1) -> bytes:
        """As of a file, but at most its size."""
        return super().read(-1 if size is None else min(size, self.size))


@contextmanager
def opened_archive(path: Path) -> Iterator[Archive]:
    """Open a zip file; errors are those of `open_regular` and any that zipfile raises."""
    with _WholeFile(open_regular(path).detach()) as file, zipfile.ZipFile(file) as archive:
        yield Archive(archive, file.size)
