"""Checks the headers of LAS and LAZ files, whose claims laspy and lazrs believe.

Format: the ASPRS LAS specification 1.4 (R15), sections 2.4 to 2.7, and for LAZ the laszip
specification (https://downloads.rapidlasso.de/doc/LAZ_Specification_1.4_R1.pdf).
"""

from __future__ import annotations

import struct
from io import BufferedReader

HEADER = struct.Struct("<94xHIIBH")  # sizes of the header, offset to the points, VLRs, format, size
COUNT = struct.Struct("<107xI")  # of points, before version 1.4
EXTENDED = struct.Struct("<235xQIQ")  # of version 1.4: the first extended VLR, how many; points
VLR, EXTENDED_VLR = struct.Struct("<2x16sHH32x"), struct.Struct("<2x16sHQ32x")
LASZIP = struct.Struct("<HHBBHIIqqH")  # of the record that describes the compression
ITEM = struct.Struct("<HHH")  # type, size and version of a part of each point
# the layers of the parts of formats 6 to 10; one of extra bytes has as many as bytes
LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
LAYERED_BYTES, LAYERED = 14, 10  # the type of extra bytes, and the least type that has layers
LASZIP_ID = 22204
IN_CHUNKS, IN_LAYERS = 2, 3  # kinds of compression
VARIABLE = 0xFFFFFFFF  # as the size of chunks: a table tells it
LARGEST_CHUNK = 1 << 24  # points


def check_las(file: BufferedReader, size: int) -> None:
    """ValueError if the header of a LAS or LAZ file claims more than the file has.

    Parameters
    ----------
    size : of the file, bytes.
    """
    file.seek(0)
    head = file.read(EXTENDED.size)
    if len(head) < HEADER.size or not head.startswith(b"LASF"):
        raise ValueError("it does not begin as one")
    length, begin, records, form, width = HEADER.unpack_from(head)
    if not HEADER.size <= length <= begin <= size or not width:
        raise ValueError("its header does not fit the file")
    extended = head[25] >= 4 and length >= EXTENDED.size and len(head) == EXTENDED.size
    place = length
    for _ in range(records):
        name, number, room = _record(file, VLR, place, begin)
        place += VLR.size + room
        if number == LASZIP_ID and name.startswith(b"laszip encoded"):
            count = (EXTENDED if extended else COUNT).unpack_from(head)[-1]
            _check_chunks(file, begin, size, width, file.read(room), count)
        if place > begin:
            raise ValueError("its records reach into the points")
    if extended:
        place, records, _ = EXTENDED.unpack_from(head)
        for _ in range(records):
            _, _, room = _record(file, EXTENDED_VLR, place, size)
            place += EXTENDED_VLR.size + room
            if place > size:
                raise ValueError("its records are beyond its end")


def _record(file: BufferedReader, form: struct.Struct, place: int, end: int
            ) -> tuple[bytes, int, int]:
    """The owner, the number and the length of a record."""
    if place + form.size > end:
        raise ValueError("its records are cut short")
    file.seek(place)
    owner, number, length = form.unpack(file.read(form.size))
    return owner, number, length


def _items(data: bytes, width: int) -> list[tuple[int, int]]:
    """The types and sizes of the parts of a point, which make its bytes."""
    if len(data) < LASZIP.size:
        raise ValueError("the record of its compression is cut short")
    *_, count = LASZIP.unpack_from(data)
    if len(data) < LASZIP.size + count * ITEM.size:
        raise ValueError("the record of its compression is cut short")
    items = [ITEM.unpack_from(data, LASZIP.size + at * ITEM.size)[:2] for at in range(count)]
    if sum(size for _, size in items) != width:
        raise ValueError("the parts of its points do not have the size of a point")
    layered = any(kind >= LAYERED for kind, _ in items)
    if layered and not all(kind in LAYERS or kind == LAYERED_BYTES for kind, _ in items):
        raise ValueError("the parts of its points do not fit each other")
    if LASZIP.unpack_from(data)[0] != (IN_LAYERS if layered else IN_CHUNKS):
        raise ValueError("its compression is not one that is read")
    return items


def _check_chunks(file: BufferedReader, begin: int, size: int, width: int, record: bytes,
                  count: int) -> None:
    """ValueError if chunks of points, or their layers, are larger than the file.

    A chunk holds its first point as it is; then, if it has layers, the number of points and the
    sizes of the layers, and the layers.

    Parameters
    ----------
    begin : where the points begin; there is the place of the table of chunks.
    width : of a point, bytes.
    record : describes the compression.
    count : of points, which the header claims.
    """
    items = _items(record, width)
    chunk = LASZIP.unpack_from(record)[6]
    table = _number(file, begin, "<q")
    if table == -1:  # written at the end, by programs that could not go back
        table = _number(file, size - 8, "<q")
    if not begin + 8 <= table <= size - 8:
        raise ValueError("the table of its chunks is beyond its end")
    chunks = _number(file, table + 4, "<I")
    if chunks * width > size:
        raise ValueError(f"its {size} bytes are too few for {chunks} chunks")
    if chunk == VARIABLE:
        sizes = _variable(file, begin, record)
    elif not 0 < chunk <= LARGEST_CHUNK or chunks != -(-count // chunk):
        raise ValueError(f"its {count} points do not make {chunks} chunks")
    else:
        sizes = [min(chunk, count - first) for first in range(0, count, chunk)]
    if sum(sizes) != count or len(sizes) != chunks:
        raise ValueError(f"its chunks do not have {count} points")
    if any(kind >= LAYERED for kind, _ in items):
        layers = sum(room if kind == LAYERED_BYTES else LAYERS[kind] for kind, room in items)
        _check_layers(file, begin + 8, table, width, layers, sizes)


def _variable(file: BufferedReader, begin: int, record: bytes) -> list[int]:
    """The numbers of points of chunks of different sizes."""
    import lazrs

    file.seek(begin)
    try:
        return [points for points, _ in lazrs.read_chunk_table(file, lazrs.LazVlr(record))]
    except (lazrs.LazrsError, RuntimeError, OSError) as error:
        raise ValueError(f"the table of its chunks is damaged ({error})") from None


def _check_layers(file: BufferedReader, begin: int, end: int, width: int, layers: int,
                  sizes: list[int]) -> None:
    """ValueError unless chunks with these numbers of points lie between two places."""
    head, place = struct.Struct(f"<{layers + 1}I"), begin
    for size in sizes:
        file.seek(place + width)
        data = file.read(head.size)
        if len(data) < head.size:
            raise ValueError("its chunks are cut short")
        points, *rooms = head.unpack(data)
        place += width + head.size + sum(rooms)
        if place > end or points != size:
            raise ValueError("a chunk of its points is larger than the file")


def _number(file: BufferedReader, place: int, form: str) -> int:
    """A number at a place of the file."""
    file.seek(max(place, 0))
    data = file.read(struct.calcsize(form))
    if len(data) < struct.calcsize(form):
        raise ValueError("the table of its chunks is cut short")
    value: int = struct.unpack(form, data)[0]
    return value
