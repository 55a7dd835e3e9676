"""Arrays from an .npz that may be damaged or malicious.

numpy allocates the size that a header claims before it reads, and its header parser raises any kind
of exception. Here the claim of each member is compared with its bytes first, and no more than that
is unpacked (io/unpack.py); nothing is unpickled.
"""

import json
import math
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.io.reason import reason
from clsplat.io.unpack import Archive, Bounded, opened_archive

CHUNK = 1 << 21  # bytes that are copied while the processor's cache holds them
READ_HEADER = {(1, 0): np.lib.format.read_array_header_1_0,
               (2, 0): np.lib.format.read_array_header_2_0}


def read_npz(path: Path, complaint: str, cure: str,
             wanted: Callable[[str], bool] = lambda name: True,
             rows: NDArray[np.integer] | None = None) -> dict[str, NDArray[Any]]:
    """Read the arrays of an .npz by name; every byte that is read is checked against its CRC.

    Parameters
    ----------
    complaint, cure : of the message for a damaged file, "PATH: COMPLAINT (the reason); CURE".
    wanted : called with the name of an array, returns whether it is read.
    rows : ascending indices of those rows that are kept of every array; None: all.
    """
    try:
        with opened_archive(path) as archive:
            members = {short: name for name in archive.members
                       if wanted(short := name.removesuffix(".npy"))}
            archive.check(members.values())
            return {short: _member(archive, short, name, rows)
                    for short, name in members.items()}
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; check the path") from None
    except Exception as error:  # zipfile and numpy raise many kinds
        raise InputError(f"{path}: {complaint} ({reason(error)}); {cure}") from None


def write_npz(file: BinaryIO, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays by name into an open file; equal arrays make equal bytes."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            # ZipInfo's fixed date keeps the bytes equal from run to run
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
                write_array(member, np.asarray(array, order="C"))


def state_array(state: Mapping[str, Any]) -> NDArray[np.uint8]:
    """A dict for JSON as an array of bytes, to be kept among arrays."""
    return np.frombuffer(json.dumps(state, default=lambda value: value.tolist()).encode(), np.uint8)


def _member(archive: Archive, short: str, name: str,
            rows: NDArray[np.integer] | None) -> NDArray[Any]:
    with archive.opened(name) as stream:
        array = read_array(short, stream, archive.members[name].file_size, rows)
        if rows is None or len(rows):
            stream.check_end()
        return array


def read_array(name: str, stream: IO[bytes] | Bounded, size: int,
               rows: NDArray[np.integer] | None = None) -> NDArray[Any]:
    """Read the array of an .npy from its stream.

    Parameters
    ----------
    name : in messages.
    stream : of the .npy, from its start.
    size : bytes of the .npy, as many as memory may be taken for.
    rows : ascending indices of the rows that are kept; None: all.

    Raises
    ------
    Exception : of any kind, since numpy's parser of headers raises many.
    """
    version = np.lib.format.read_magic(stream)
    if version not in READ_HEADER:
        raise ValueError(f"array {name!r} has an unknown version of its format")
    shape, by_columns, dtype = READ_HEADER[version](stream)
    size -= stream.tell()
    if dtype.hasobject or min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != size:
        raise ValueError(f"array {name!r} does not have the size that its header claims")
    if rows is not None:
        return _read_rows(name, stream, shape, dtype, by_columns, rows)
    content = np.empty(size, np.uint8)
    for begin in range(0, size, CHUNK):
        part = content[begin:begin + CHUNK]
        read = stream.read(len(part))
        if len(read) != len(part):
            raise ValueError(f"array {name!r} is cut short")
        part[:] = np.frombuffer(read, np.uint8)
    return np.ndarray(shape, dtype, content.data, order="F" if by_columns else "C")


def _read_rows(name: str, stream: IO[bytes] | Bounded, shape: tuple[int, ...], dtype: np.dtype[Any],
               by_columns: bool, rows: NDArray[np.integer]) -> NDArray[Any]:
    """Some rows of an array: memory is taken for these only. If there are any, all of it is read,
    for its CRC."""
    if by_columns or not shape or len(rows) and rows[-1] >= shape[0]:
        raise ValueError(f"array {name!r} does not have these rows")
    kept = np.empty((len(rows), *shape[1:]), dtype)
    if not len(rows):
        return kept
    width = dtype.itemsize * math.prod(shape[1:])
    together = max(1, CHUNK // max(1, width))
    for begin in range(0, shape[0], together):
        end = min(begin + together, shape[0])
        read = stream.read((end - begin) * width)
        if len(read) != (end - begin) * width:
            raise ValueError(f"array {name!r} is cut short")
        first, last = np.searchsorted(rows, (begin, end))
        part = np.frombuffer(read, dtype).reshape(-1, *shape[1:])
        kept[first:last] = part[rows[first:last] - begin]
    return kept


def write_array(member: IO[bytes], array: NDArray[Any]) -> None:
    """Write a contiguous array as an .npy."""
    if array.dtype.hasobject:
        raise ValueError("an array of objects is not written")
    np.lib.format.write_array_header_1_0(member, np.lib.format.header_data_from_array_1_0(array))
    content = array.reshape(-1).view(np.uint8)
    for begin in range(0, len(content), CHUNK):
        member.write(content[begin:begin + CHUNK].data)
