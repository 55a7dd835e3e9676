"""Gaussians as SPZ, the compressed format of Niantic: versions 3 and 4 are written, 2 to 4 read.

A gzip stream of a header and then, one after the other for all gaussians: positions of 24 bits,
opacities, colours, scales, rotations, and harmonics of 8 bits. Version 4 has a header of 32 bytes,
a table of the packed and unpacked size of each part, and the parts as streams of Zstandard without
gaps (README.md of nianticlabs/spz); readers skip what stands before the table. The axes are right,
up, backward: those of a PLY, which are right, down, forward, after half a turn about x.
"""

import io
import math
import re
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.io.atomic import replacing
from clsplat.io.fields import reading
from clsplat.io.models import values
from clsplat.io.regular import check_rows, read_regular

HEADER = struct.Struct("<4sIIBBBB")  # magic, version, count, SH degree, fractional bits, flags
HEADER_4 = struct.Struct("<16sI12x")  # of version 4: HEADER, where the table begins
ENTRY = struct.Struct("<QQ")  # the sizes of a stream
MAGIC, VERSION, WITH_STREAMS = b"NGSP", 3, 4
VERSIONS = (VERSION, WITH_STREAMS)  # that are written, first the one that most programs read
ANTIALIASED, EXTENDED = 1, 2  # flags
# with the flags, and without the time, so that equal models give equal bytes
GZIP_HEADER = b"\x1f\x8b\x08%c\0\0\0\0\2\xff"
LEVEL = 6  # of deflate: 9 makes files 1 to 3 % smaller in eight times the time
ZSTD_LEVEL = 12  # that of the reference implementation
COMMENT = 16  # the flag of a comment, which ends with a zero byte; other readers skip it
ORIGIN = re.compile(rb"origin_of_positions (\S+) (\S+) (\S+)")
ROTATION_BYTES = {2: 3, 3: 4, 4: 4}  # by the version
HIGHEST_DEGREE = 3  # of harmonics
COLOURS, LOG_SCALES = values.Steps(0.15 * 255, 127.5), values.Steps(16, 160)
HARMONICS = values.Steps(128, 128)
# the least significant bits of harmonics that are zero, so that they compress, as in the reference
# implementation: of the first degree, of the others
SH_BUCKETS = (8, 16)
XYZW = np.array([1, 2, 3, 0])  # where these components stand in w, x, y, z
POSITION_LIMIT, MOST_FRACTIONAL_BITS = (1 << 23) - 1, 24
FEWEST_STEPS = 1 << 12  # of the model's size
SMALLEST_EXTENT = 1e-9  # more bits than this needs are not there
POSITION_STEP = 0.2  # at most, of a position, in median standard deviations


class _Header(NamedTuple):
    version: int
    number: int  # of gaussians
    degree: int
    bits: int  # below one in a position
    flags: int
    streams: int


def write_spz(path: Path, gaussians: Gaussians, notes: values.Notes, version: int = VERSION) -> None:
    """Write gaussians as SPZ of one of VERSIONS; see `models.write_model`.

    They are sorted along a curve in space. Harmonics whose bytes would all be zero are left out.
    Of the comments, only whether the model is antialiased has a place.
    """
    try:
        content, _ = packed_spz(path, gaussians, notes, version)
    except ImportError as error:
        raise InputError(f"{path}: {error}") from None
    with replacing(path) as file:
        file.write(content)


def packed_spz(path: Path, gaussians: Gaussians, notes: values.Notes, version: int = VERSION) -> tuple[bytes, int]:
    """The content of a SPZ file, and the degree of its harmonics; `path` is for messages.

    ImportError without zstandard, which version 4 needs.
    """
    rows, origin = values.stored_rows(gaussians, along_curve=True)
    rows = values.half_turn(rows, axis=0)
    bits = _fractional_bits(path, rows["positions"], gaussians.log_scales)
    fixed = np.rint(rows["positions"] * 2.0**bits).astype("<i4")
    bucket = np.where(np.arange(rows["sh_rest"].shape[1]) < 3, *SH_BUCKETS)[:, None]
    sh = HARMONICS.bytes(np.floor(rows["sh_rest"] * HARMONICS.scale / bucket + 0.5) * bucket / HARMONICS.scale)
    degree = gaussians.sh_degree
    while degree and not (sh[:, degree**2 - 1 :] != HARMONICS.zero).any():
        degree -= 1
        sh = sh[:, : (degree + 1) ** 2 - 1]
    parts = [
        part.tobytes()
        for part in (
            fixed.view(np.uint8).reshape(-1, 4)[:, :3],
            values.OPACITY_STEPS.bytes(scipy.special.expit(rows["opacity_logits"])),
            COLOURS.bytes(rows["sh_constant"]),
            LOG_SCALES.bytes(rows["log_scales"]),
            _packed_rotations(rows["quaternions"]),
            sh,
        )
    ]
    comment = b""
    if origin.any():
        comment = f"origin_of_positions {' '.join(map(repr, origin.tolist()))}\0".encode()
    fields = MAGIC, version, gaussians.count, degree, bits, ANTIALIASED * notes.antialiased
    if version == WITH_STREAMS:
        return _in_streams(fields, comment, list(filter(None, parts))), degree
    content = HEADER.pack(*fields, 0) + b"".join(parts)
    head = GZIP_HEADER % (COMMENT * bool(comment)) + comment
    packer = zlib.compressobj(LEVEL, zlib.DEFLATED, -zlib.MAX_WBITS, 9)
    end = struct.pack("<II", zlib.crc32(content), len(content) & 0xFFFFFFFF)
    return head + packer.compress(content) + packer.flush() + end, degree


def _in_streams(fields: tuple[bytes | int, ...], comment: bytes, parts: Sequence[bytes]) -> bytes:
    """A file of version 4, of the fields of its header but the number of its parts."""
    packed = [_zstandard().ZstdCompressor(ZSTD_LEVEL).compress(part) for part in parts]
    return b"".join(
        (
            HEADER_4.pack(HEADER.pack(*fields, len(parts)), HEADER_4.size + len(comment)),
            comment,
            *(ENTRY.pack(len(small), len(part)) for small, part in zip(packed, parts)),
            *packed,
        )
    )


def read_spz(path: Path, offset: NDArray[np.float64] | None = None) -> tuple[Gaussians, values.Notes]:
    """Read a SPZ file; see `models.read_with_notes`."""
    with reading(path, "a SPZ file"):
        data = read_regular(path)
        return (
            values.gaussians_of(path, unpacked_spz(data), _origin(data), offset),
            values.Notes((values.MIP,) if _header(data).flags & ANTIALIASED else ()),
        )


def unpacked_spz(data: bytes) -> dict[str, NDArray[np.float64]]:
    """The fields of `gaussians.LEARNED` of a SPZ file's content, positions relative to its origin;
    ValueError if it is damaged."""
    header = _header(data)
    count, bands = header.number, (header.degree + 1) ** 2 - 1
    check_rows(len(data), count, bands)
    shapes = [(count, *shape) for shape in ((9,), (1,), (3,), (3,), (ROTATION_BYTES[header.version],), (bands, 3))]
    in_streams = header.version == WITH_STREAMS and (header.streams or not count)
    contents = (_streams if in_streams else _stream)(data, header, list(map(math.prod, shapes)))
    position, opacity, colour, scale, rotation, sh = (
        np.frombuffer(content, np.uint8).reshape(shape) for content, shape in zip(contents, shapes)
    )
    fixed = np.zeros((count, 3, 4), np.uint8)
    fixed[..., 1:] = position.reshape(count, 3, 3)  # the upper bytes keep the sign
    return values.half_turn(
        {
            "positions": (fixed.view("<i4")[..., 0] >> 8) / 2.0**header.bits,
            "sh_constant": COLOURS.values(colour),
            "sh_rest": HARMONICS.values(sh),
            "opacity_logits": values.byte_logits(opacity[:, 0]),
            "log_scales": LOG_SCALES.values(scale),
            "quaternions": _rotations(rotation),
        },
        axis=0,
    )


def _header(data: bytes) -> _Header:
    if not data.startswith(MAGIC):
        data = zlib.decompressobj(zlib.MAX_WBITS | 16).decompress(data, HEADER.size)
    magic, *numbers = HEADER.unpack_from(data)
    header = _Header(*numbers)
    if magic != MAGIC:
        raise ValueError("its header is another")
    if header.version not in ROTATION_BYTES:
        raise ValueError(f"versions {min(ROTATION_BYTES)} to {WITH_STREAMS} are read, not {header.version}")
    if header.degree > HIGHEST_DEGREE or header.bits > MOST_FRACTIONAL_BITS:
        raise ValueError(f"SH degree {header.degree}, {header.bits} fractional bits")
    if header.flags & EXTENDED:
        raise ValueError("its extensions are not read; write it without them")
    return header


def _stream(data: bytes, header: _Header, sizes: Sequence[int]) -> list[bytes]:
    """The parts of a file that is one gzip stream, or was unpacked on its way, as servers do."""
    size = HEADER.size + sum(sizes)
    ended = data.startswith(MAGIC)
    if not ended:
        stream = zlib.decompressobj(zlib.MAX_WBITS | 16)
        data = stream.decompress(data, size + 1)
        ended = stream.eof  # where the checksum was compared
    if len(data) != size or not ended:
        raise ValueError(f"its {header.number} gaussians have another size")
    content = io.BytesIO(data[HEADER.size :])
    return [content.read(size) for size in sizes]


def _streams(data: bytes, header: _Header, sizes: Sequence[int]) -> list[bytes]:
    """The parts of a file of version 4, of which empty ones are left out."""
    zstandard = _zstandard()
    _, table = HEADER_4.unpack_from(data)
    at = table + header.streams * ENTRY.size
    if header.streams != sum(map(bool, sizes)):
        raise ValueError(f"its table of {header.streams} streams does not fit")
    entries, parts = ENTRY.iter_unpack(data[table:at]), []
    for size in sizes:
        packed, claimed = next(entries) if size else (0, 0)
        if claimed != size:
            raise ValueError(f"a stream of {size} bytes claims to hold {claimed}")
        stream = zstandard.ZstdDecompressor().stream_reader(data[at : at + packed])
        parts.append(stream.read(size + 1) if size else b"")
        if len(parts[-1]) != size:
            raise ValueError("it holds more or less than its header claims")
        at += packed
    return parts


def _zstandard() -> ModuleType:
    """The library of an extra; ImportError that names it."""
    try:
        import zstandard
    except ImportError:
        raise ImportError("SPZ of version 4 needs zstandard; `pip install zstandard`") from None
    return zstandard


def _fractional_bits(path: Path, positions: NDArray[np.float64], log_scales: NDArray[np.float32]) -> int:
    """The bits below one in 24: as many as the gaussians need, if the largest position fits."""
    if not len(positions):
        return 0
    largest = max(float(np.abs(positions).max()), SMALLEST_EXTENT)
    most = int(np.floor(np.log2(POSITION_LIMIT / largest)))
    if most < 0:
        raise InputError(
            f"{path}: SPZ holds positions below {POSITION_LIMIT:,}, and the farthest "
            f"is at {largest:g}; remove what is so far away, or write another format"
        )
    extent = max(float(np.ptp(positions, axis=0).max()), SMALLEST_EXTENT)
    needed = int(np.ceil(np.log2(max(FEWEST_STEPS / extent, np.exp(-float(np.median(log_scales))) / POSITION_STEP))))
    return min(most, max(needed, 0), MOST_FRACTIONAL_BITS)


def _packed_rotations(quaternions: NDArray[np.float64]) -> NDArray[np.uint32]:
    """Two bits for the largest of x, y, z, w, then a sign and nine bits for each of the others."""
    largest, others = values.smallest_three(quaternions[:, XYZW])
    packed = largest.astype("<u4")
    for value in others.T:
        size = np.rint(np.abs(value) * np.sqrt(2) * 511).astype(np.uint32)
        packed = packed << 10 | (value < 0).astype(np.uint32) << 9 | np.minimum(size, 511)
    return packed.astype("<u4")


def _rotations(data: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Quaternions w, x, y, z from the three bytes of version 2 or the four of version 3."""
    if data.shape[1] == ROTATION_BYTES[2]:
        others = data / 127.5 - 1
        return np.column_stack([np.sqrt(np.maximum(0, 1 - (others**2).sum(axis=1))), others])
    packed = np.ascontiguousarray(data).view("<u4")[:, 0]
    fields = np.stack([packed >> shift & 1023 for shift in (20, 10, 0)], axis=1).astype(np.int64)
    others = (fields & 511) * np.where(fields > 511, -1, 1) / (511 * np.sqrt(2))
    quaternions = values.from_smallest_three(packed >> 30, others)
    return np.asarray(quaternions[:, np.argsort(XYZW)], np.float64)


def _origin(data: bytes) -> NDArray[np.float64]:
    """What the comment of the gzip header records, or that before the table of version 4, or
    zero."""
    begin = HEADER_4.size if data.startswith(MAGIC) else len(GZIP_HEADER % 0)
    has_comment = data.startswith(MAGIC) or data[3] & COMMENT
    found = ORIGIN.fullmatch(data[begin:].partition(b"\0")[0]) if has_comment else None
    return np.array([float(value) for value in found.groups()] if found else (0, 0, 0), np.float64)
