"""The container of SPZ version 4: a header of 32 bytes, extensions, a table, streams of Zstandard.

Format: the README and the extensions/README.md of nianticlabs/spz. The table, at a place that the
header names, has two numbers of 64 bits for each stream, its size packed and unpacked; the streams
follow it without gaps, and empty ones are left out.
"""

import io
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import IO

from clsplat.io.unpack import Bounded

HEADER_BYTES, TABLE_AT = 32, struct.Struct("<16xI")
ENTRY, EXTENSION = struct.Struct("<QQ"), struct.Struct("<II")  # sizes; kind and length
# an extension of Adobe for gaussians with other axes than the format's
OTHER_AXES = 0xADBE0003
CURE = "`pip install zstandard`"


def streams(data: bytes, number: int, sizes: Sequence[int], extended: bool) -> list[bytes]:
    """The parts of a file.

    Parameters
    ----------
    data : the whole file.
    number : of streams, which the header claims.
    sizes : bytes of each part.
    extended : whether extensions stand between header and table.

    Raises
    ------
    ValueError : it is damaged, or holds another number of bytes.
    ImportError : there is no library for Zstandard.
    """
    if len(data) < HEADER_BYTES:
        raise ValueError("its header is cut short")
    table, = TABLE_AT.unpack_from(data)
    if number != sum(map(bool, sizes)) or not (
            HEADER_BYTES <= table <= len(data) - number * ENTRY.size):
        raise ValueError(f"its table of {number} streams does not fit")
    if extended:
        check_extensions(data[HEADER_BYTES:table])
    at, parts = table + number * ENTRY.size, []
    entries = iter([ENTRY.unpack_from(data, table + row * ENTRY.size) for row in range(number)])
    for size in sizes:
        packed, claimed = next(entries) if size else (0, 0)
        if claimed != size or packed > len(data) - at:
            raise ValueError(f"a stream of {size} bytes claims to hold {claimed}")
        parts.append(_unpacked(data[at:at + packed], size) if size else b"")
        at += packed
    return parts


def check_extensions(data: bytes) -> None:
    """ValueError if extensions are damaged, or stand for other axes."""
    while data:
        if len(data) < EXTENSION.size:
            raise ValueError("its extensions are cut short")
        kind, size = EXTENSION.unpack_from(data)
        if size > len(data) - EXTENSION.size:
            raise ValueError("its extensions are cut short")
        if kind == OTHER_AXES:
            raise ValueError("its extension for other axes is not read")
        data = data[EXTENSION.size + size:]


def _unpacked(data: bytes, size: int) -> bytes:
    with _opened(io.BytesIO(data)) as stream:
        bounded = Bounded(stream, size)
        content = bounded.read()
        bounded.check_end()
        return content


@contextmanager
def _opened(file: IO[bytes]) -> Iterator[IO[bytes]]:
    """A stream of Zstandard."""
    try:
        import zstandard
    except ImportError:
        raise ImportError(f"SPZ of version 4 needs zstandard; {CURE}") from None
    with zstandard.ZstdDecompressor().stream_reader(file) as stream:
        yield stream
