"""Arrays from an .npz that may be damaged or made to do harm.

numpy allocates what a header claims before it reads, and its parser of headers raises whatever it
stumbles on. Here every member's claim is compared with its bytes first; nothing is unpickled.
"""

import io
import math
import zipfile

import numpy as np

from clsplat.errors import InputError
from clsplat.io.reason import reason
from clsplat.io.regular import open_regular

# a compressed file may hold so many times its size, beyond a floor for small ones: a zip bomb more
EXPANSION = 100
FLOOR_BYTES = 1 << 26
READ_HEADER = {(1, 0): np.lib.format.read_array_header_1_0,
               (2, 0): np.lib.format.read_array_header_2_0}


def read_npz(path, what, cure, wanted=None):
    """{name: array} of an .npz; every byte read is checked against its CRC.

    wanted: names to read, of those that are there; None: all. Raises InputError, "`path`: `what`
    (the reason); `cure`", for whatever is not a whole .npz of arrays.
    """
    try:
        with _Bounded(open_regular(path).detach()) as file, zipfile.ZipFile(file) as archive:
            members = {member.filename.removesuffix(".npy"): member
                       for member in archive.infolist()}
            members = {name: member for name, member in members.items()
                       if wanted is None or name in wanted}
            _check_sizes(file.size, members.values())
            return {name: _array(name, archive.read(member)) for name, member in members.items()}
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; check the path") from None
    except Exception as error:  # there is no end to what zipfile and numpy raise
        raise InputError(f"{path}: {what} ({reason(error)}); {cure}") from None


class _Bounded(io.BufferedReader):
    """zipfile asks for as much as a header claims, and Python allocates what is asked for."""

    def __init__(self, raw):
        super().__init__(raw)
        self.size = self.seek(0, io.SEEK_END)

    def read(self, size=-1):
        return super().read(min(size, self.size))


def _check_sizes(size, members):
    claimed = sum(member.file_size for member in members)
    if claimed > FLOOR_BYTES + EXPANSION * size:
        raise ValueError(f"its {size} bytes claim to hold {claimed}")


def _array(name, content):
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    if version not in READ_HEADER:
        raise ValueError(f"array {name!r} is of an unknown version")
    shape, by_columns, dtype = READ_HEADER[version](stream)
    if dtype.hasobject or min(shape, default=0) < 0 or (
            math.prod(shape) * dtype.itemsize != len(content) - stream.tell()):
        raise ValueError(f"array {name!r} has not the bytes of its header")
    rows = bytearray(memoryview(content)[stream.tell():])  # that may be written to
    return np.ndarray(shape, dtype, rows, order="F" if by_columns else "C")
