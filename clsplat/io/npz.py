"""Arrays from an .npz that may be damaged or malicious: nothing is unpickled."""

import json
import math
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from io import SEEK_CUR, BytesIO
from pathlib import Path
from struct import unpack
from typing import Any, BinaryIO
from zipfile import ZIP_STORED, ZipFile, ZipInfo
from zlib import crc32

import numpy as np
from numpy.lib.format import (
    header_data_from_array_1_0,
    read_array_header_1_0,
    read_array_header_2_0,
    read_magic,
    write_array_header_1_0,
)
from numpy.typing import NDArray

from clsplat.io.records import check_format, object_of
from clsplat.io.regular import opened_archive

THREADS = 4  # that read arrays of a file
PART_BYTES = 1 << 20  # so few that they are in the cache while their CRC is computed
LARGEST_HEADER = 1 << 16  # bytes that describe an array


def read_npz(path: Path, wanted: Callable[[str], bool] = lambda name: True) -> dict[str, NDArray[Any]]:
    """Read the arrays of an .npz that is not compressed by name; every byte that is read is checked
    against its CRC. Through zipfile this takes three times as long.

    Raises exceptions of any kind for a damaged file, see `fields.reading`.

    Parameters
    ----------
    wanted : called with the name of an array, returns whether it is read.
    """
    with (
        opened_archive(path, lambda name: wanted(name.removesuffix(".npy"))) as (_, members),
        ThreadPoolExecutor(THREADS) as threads,
    ):
        return dict(
            zip(
                (name.removesuffix(".npy") for name in members),
                threads.map(lambda member: _read_array(path, member), members.values()),
            )
        )


def read_rows(path: Path, wanted: Callable[[str], bool], rows: NDArray[np.integer]) -> dict[str, NDArray[Any]]:
    """Some `rows` int[K] of arrays, as `read_npz` returns them; no other bytes are read, so that no
    CRC is compared. A third of the rows takes an eighth of the time of all."""
    with opened_archive(path, lambda name: wanted(name.removesuffix(".npy"))) as (_, members):
        found = {}
        for name, member in members.items():
            with open(path, "rb") as file:
                _seek_content(file, member)
                content = np.memmap(file, np.uint8, "r", file.tell(), (member.file_size,))
            begin, shape, by_columns, dtype = _described(content)
            if by_columns:
                raise ValueError(f"{name} is stored by columns")
            row_bytes = dtype.itemsize * math.prod(shape[1:])
            some = np.asarray(content)[begin:].reshape(shape[0], row_bytes)[rows]
            found[name.removesuffix(".npy")] = some.view(dtype).reshape(len(rows), *shape[1:])
        return found


def write_npz(file: BinaryIO, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays by name into an open file, as `numpy.savez` in half of its time; equal arrays
    make equal bytes."""
    with ZipFile(file, "w") as archive:
        for name, values in arrays.items():
            by_rows = np.asarray(values, order="C")
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                write_array_header_1_0(member, header_data_from_array_1_0(by_rows))
                content = by_rows.reshape(-1).view(np.uint8).data
                for begin in range(0, len(content), PART_BYTES):
                    member.write(content[begin : begin + PART_BYTES])


def state_array(state: Mapping[str, Any]) -> NDArray[np.uint8]:
    """A dict for JSON as an array of bytes, to be kept among arrays."""
    return np.frombuffer(json.dumps(state, default=lambda value: value.tolist()).encode(), np.uint8)


def state_of(path: Path, array: NDArray[Any]) -> dict[str, Any]:
    """The dict of a `state_array` of a file; errors as of `object_of` and `check_format`."""
    state = object_of(array.tobytes())
    check_format(path, state)
    return state


def _read_array(path: Path, member: ZipInfo) -> NDArray[Any]:
    """The array of a member; numpy's own reader would allocate what a header claims."""
    content, crc = np.empty(member.file_size, np.uint8), 0
    with open(path, "rb", buffering=0) as file:
        _seek_content(file, member)
        for begin in range(0, len(content), PART_BYTES):
            part = content.data[begin : begin + PART_BYTES]
            if file.readinto(part) != len(part):
                raise ValueError("it ends too early")
            crc = crc32(part, crc)
    if crc != member.CRC:
        raise ValueError(f"the CRC of {member.filename} is wrong")
    begin, shape, by_columns, dtype = _described(content)
    return content[begin:].view(dtype).reshape(shape, order="F" if by_columns else "C")


def _seek_content(file: BinaryIO, member: ZipInfo) -> None:
    """Go to the first byte of a member of a zip file."""
    if member.compress_type != ZIP_STORED or member.flag_bits & 1:
        raise ValueError("it is compressed or encrypted")
    file.seek(member.header_offset)
    name_length, extra_length = unpack("<26x2H", file.read(30))
    if file.read(name_length) != member.orig_filename.encode():  # no CRC is over either
        raise ValueError(f"{member.filename} has two names")
    file.seek(extra_length, SEEK_CUR)


def _described(content: NDArray[np.uint8]) -> tuple[int, tuple[int, ...], bool, np.dtype[Any]]:
    """Where the values of an array begin, its shape, whether it is stored by columns, its type."""
    read_header = {(1, 0): read_array_header_1_0, (2, 0): read_array_header_2_0}
    header = BytesIO(content.data[:LARGEST_HEADER])
    described = read_header[read_magic(header)](header)
    return header.tell(), *described
