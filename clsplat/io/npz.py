"""Arrays from an .npz that may be damaged or malicious: nothing is unpickled."""

import json
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, BinaryIO, cast
from zipfile import ZipExtFile, ZipFile, ZipInfo

import numpy as np
from numpy.lib.format import read_array_header_1_0, read_array_header_2_0, read_magic
from numpy.typing import NDArray

from clsplat.io.regular import opened_archive

THREADS = 4  # that read arrays of a file
READ_BYTES = 1 << 20  # so few that they are in the cache while they are copied


def read_npz(path: Path, wanted: Callable[[str], bool] = lambda name: True
             ) -> dict[str, NDArray[Any]]:
    """Read the arrays of an .npz by name; every byte that is read is checked against its CRC.

    Raises exceptions of any kind for a damaged file, see `fields.reading`.

    Parameters
    ----------
    wanted : called with the name of an array, returns whether it is read.
    """
    with opened_archive(path, lambda name: wanted(name.removesuffix(".npy"))
                        ) as (_, members), ThreadPoolExecutor(THREADS) as threads:

        def read(member: ZipInfo) -> NDArray[Any]:
            # threads must not share a file: a seek of zipfile is relative to where others read
            with ZipFile(path) as own, own.open(member) as stream:
                return _read_array(cast(ZipExtFile, stream), member.file_size)

        return dict(zip((name.removesuffix(".npy") for name in members),
                        threads.map(read, members.values())))


def write_npz(file: BinaryIO, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays by name into an open file; equal arrays make equal bytes."""
    by_rows: dict[str, Any] = {name: np.asarray(each, order="C") for name, each in arrays.items()}
    np.savez(file, **by_rows)


def state_array(state: Mapping[str, Any]) -> NDArray[np.uint8]:
    """A dict for JSON as an array of bytes, to be kept among arrays."""
    return np.frombuffer(json.dumps(state, default=lambda value: value.tolist()).encode(), np.uint8)


def _read_array(stream: ZipExtFile, size: int) -> NDArray[Any]:
    """The array of an .npy of `size` bytes; numpy's own reader would allocate what a header claims.
    """
    read_header = {(1, 0): read_array_header_1_0, (2, 0): read_array_header_2_0}
    shape, by_columns, dtype = read_header[read_magic(stream)](stream)
    left = size - stream.tell()
    content = np.empty(left, np.uint8)
    for begin in range(0, left, READ_BYTES):
        part = content.data[begin:begin + READ_BYTES]
        if stream.readinto(part) != len(part):
            raise ValueError("it ends too early")
    if stream.read(1):
        raise ValueError("it is longer than it says")
    return content.view(dtype).reshape(shape, order="F" if by_columns else "C")
