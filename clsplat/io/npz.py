"""Arrays from an .npz that may be damaged or malicious.

numpy allocates the size that a header claims before it reads, and its header parser raises any kind
of exception. Here the claim of each member is compared with its bytes first; nothing is unpickled.
"""

import io
import json
import math
import zipfile
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.io.reason import reason
from clsplat.io.regular import open_regular

# the members may have this many times the size of the file, plus a share for small files; a zip
# bomb has more
LARGEST_EXPANSION, FREE_BYTES = 100, 1 << 26
READ_HEADER = {(1, 0): np.lib.format.read_array_header_1_0,
               (2, 0): np.lib.format.read_array_header_2_0}


def read_npz(path: Path, complaint: str, cure: str, names: Collection[str] | None = None
             ) -> dict[str, NDArray[Any]]:
    """Read the arrays of an .npz by name; every byte that is read is checked against its CRC.

    Parameters
    ----------
    complaint, cure : of the message for a damaged file, "PATH: COMPLAINT (the reason); CURE".
    names : of the arrays to read, some of which may be missing; None reads all.
    """
    try:
        with Bounded(open_regular(path).detach()) as file, zipfile.ZipFile(file) as archive:
            members = {member.filename.removesuffix(".npy"): member
                       for member in archive.infolist()}
            members = {name: member for name, member in members.items()
                       if names is None or name in names}
            claimed = sum(member.file_size for member in members.values())
            if claimed > FREE_BYTES + LARGEST_EXPANSION * file.size:
                raise ValueError(f"its {file.size} bytes claim to hold {claimed}")
            return {name: array_of(name, archive.read(member)) for name, member in members.items()}
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
                np.lib.format.write_array(member, np.asanyarray(array), allow_pickle=False)


def state_array(state: Mapping[str, Any]) -> NDArray[np.uint8]:
    """A dict for JSON as an array of bytes, to be kept among arrays."""
    return np.frombuffer(json.dumps(state, default=lambda value: value.tolist()).encode(), np.uint8)


class Bounded(io.BufferedReader):
    """A file that reads no more than its size: zipfile reads as much as a header claims, and Python
    allocates that much first."""

    def __init__(self, raw: io.RawIOBase) -> None:
        super().__init__(raw)
        self.size = self.seek(0, io.SEEK_END)

    def read(self, size: int | None = -1) -> bytes:
        """As of a file, but at most its size."""
        return super().read(-1 if size is None else min(size, self.size))


def array_of(name: str, content: bytes) -> NDArray[Any]:
    """The array of the bytes of an .npy; nothing is allocated that its header only claims.

    Raises
    ------
    Exception : of any kind, since numpy's parser of headers raises many.
    """
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    if version not in READ_HEADER:
        raise ValueError(f"array {name!r} has an unknown version of its format")
    shape, by_columns, dtype = READ_HEADER[version](stream)
    if dtype.hasobject or min(shape, default=0) < 0 or (
            math.prod(shape) * dtype.itemsize != len(content) - stream.tell()):
        raise ValueError(f"array {name!r} does not have the size that its header claims")
    rows = bytearray(memoryview(content)[stream.tell():])  # writable, as the bytes are not
    return np.ndarray(shape, dtype, rows, order="F" if by_columns else "C")
