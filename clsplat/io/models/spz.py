"""Gaussians as SPZ, the compressed format of Niantic: version 3 is written, 1 to 4 are read.

A gzip stream of a header and then, one after the other for all gaussians: positions of 24 bits,
opacities, colours, scales, rotations, and harmonics of 8 bits. Version 4 has these parts as streams
of Zstandard (io/models/spz_streams.py). The axes are right, up, backward: those of a PLY, which are
right, down, forward, after half a turn about x.
"""

import logging
import re
import struct
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.io.atomic import replacing
from clsplat.io.models.quantise import from_smallest_three, morton_order, smallest_three
from clsplat.io.models.spz_streams import check_extensions, streams
from clsplat.io.models.values import (
    MIP,
    Notes,
    byte_logits,
    doubles,
    gaussians_of,
    half_turn,
    opacities,
    reading,
    stored_positions,
    to_bytes,
)
from clsplat.io.regular import read_regular
from clsplat.io.unpack import check_expansion, check_rows

HEADER = struct.Struct("<4sIIBBBB")  # magic, version, count, SH degree, fractional bits, flags
ANTIALIASED, EXTENDED = 1, 2  # of the flags
MAGIC, VERSION = b"NGSP", 3
WITH_STREAMS = 4  # the version whose parts are streams of their own
# with the flags, and without the time, so that equal models give equal bytes
GZIP_HEADER = b"\x1f\x8b\x08%c\0\0\0\0\2\xff"
COMMENT = 16  # the flag of a comment, which ends with a zero byte; other readers skip it
ORIGIN = re.compile(rb"origin_of_positions (\S+) (\S+) (\S+)")
# of a version: bytes of a position and of a rotation
PLACE_BYTES, ROTATION_BYTES = {1: 6, 2: 9, 3: 9, 4: 9}, {1: 3, 2: 3, 3: 4, 4: 4}
HALF = 6  # bytes of a position that are three numbers of 16 bits
MOST_EXTENSION_BYTES = 1 << 16  # of a gzip stream, behind the gaussians
HIGHEST_DEGREE, KEPT_DEGREE = 4, 3  # of harmonics
XYZW = np.array([1, 2, 3, 0])  # where these components stand in w, x, y, z
POSITION_LIMIT = (1 << 23) - 1
MOST_FRACTIONAL_BITS = 24
FEWEST_STEPS = 1 << 12  # of the model's size
SMALLEST_EXTENT = 1e-9  # more bits than this needs are not there
POSITION_STEP = 0.2  # at most, of a position, in median standard deviations
COLOUR_SCALE = 0.15
SCALE_STEPS, SMALLEST_LOG_SCALE = 16, -10
SH_STEPS = 128
# the least significant bits of harmonics that are zero, so that they compress, as in the reference
# implementation: of the first degree, of the others
SH_BUCKETS = (8, 16)


def write_spz(path: Path, gaussians: Gaussians, notes: Notes) -> None:
    """Write gaussians as SPZ; see `models.write_model`.

    They are sorted along a curve in space. Harmonics whose bytes would all be zero are left out.
    Of the comments, only whether the model is antialiased has a place.
    """
    content, _ = packed_spz(path, gaussians, notes)
    with replacing(path) as file:
        file.write(content)


def packed_spz(path: Path, gaussians: Gaussians, notes: Notes) -> tuple[bytes, int]:
    """The content of a SPZ file, and the degree of its harmonics; `path` is for messages."""
    positions, origin = stored_positions(gaussians)
    order = morton_order(positions)
    rows = half_turn({**doubles(gaussians, order), "positions": positions[order]}, axis=0)
    bits = _fractional_bits(path, positions, gaussians.log_scales)
    fixed = np.rint(rows["positions"] * 2.0**bits).astype("<i4")
    sh = _sh_bytes(rows["sh_rest"])
    degree = gaussians.sh_degree
    while degree and not (sh[:, degree**2 - 1:] != SH_STEPS).any():
        degree -= 1
        sh = sh[:, :(degree + 1) ** 2 - 1]
    content = b"".join((
        HEADER.pack(MAGIC, VERSION, gaussians.count, degree, bits,
                    ANTIALIASED * notes.antialiased, 0),
        fixed.view(np.uint8).reshape(-1, 4)[:, :3].tobytes(),
        to_bytes(255 * opacities(gaussians)[order]).tobytes(),
        to_bytes((rows["sh_constant"] * COLOUR_SCALE + 0.5) * 255).tobytes(),
        to_bytes((rows["log_scales"] - SMALLEST_LOG_SCALE) * SCALE_STEPS).tobytes(),
        _packed_rotations(rows["quaternions"]).tobytes(),
        sh.tobytes()))
    head = GZIP_HEADER % 0
    if origin.any():
        place = " ".join(repr(float(value)) for value in origin)
        head = GZIP_HEADER % COMMENT + f"origin_of_positions {place}\0".encode()
    packer = zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS, 9)
    end = struct.pack("<II", zlib.crc32(content), len(content) & 0xFFFFFFFF)
    return head + packer.compress(content) + packer.flush() + end, degree


def read_spz(path: Path, offset: NDArray[np.float64] | None = None) -> Gaussians:
    """Read the gaussians of a SPZ file; see `models.read_model`."""
    with reading(path, "a SPZ file"):
        data = read_regular(path)
        content = _unpacked(data)
        if content.degree > KEPT_DEGREE:
            logging.getLogger(__name__).warning(
                "%s: its spherical harmonics of degree %d are left out: degree %d is the highest "
                "that is read", path, content.degree, KEPT_DEGREE)
        return gaussians_of(path, _rows(content), _origin(data), offset)


def unpacked_spz(data: bytes) -> dict[str, NDArray[np.float64]]:
    """The fields of `gaussians.LEARNED` of a SPZ file's content, positions relative to its origin;
    ValueError if it is damaged."""
    return _rows(_unpacked(data))


def spz_notes(path: Path) -> Notes:
    """What a SPZ file holds besides its gaussians; see `models.read_notes`."""
    with reading(path, "a SPZ file"):
        return Notes((MIP,) if _header(_begin(read_regular(path))).flags & ANTIALIASED else ())


class _Header(NamedTuple):
    version: int
    number: int
    degree: int
    bits: int
    flags: int
    streams: int

    @property
    def widths(self) -> tuple[int, ...]:
        """The bytes of a gaussian in each part."""
        return (PLACE_BYTES[self.version], 1, 3, 3, ROTATION_BYTES[self.version],
                3 * ((self.degree + 1) ** 2 - 1))


class _Content(NamedTuple):
    degree: int
    bits: int
    parts: list[NDArray[np.uint8]]  # [N, width] each


def _begin(data: bytes) -> bytes:
    """The first bytes, unpacked."""
    if data.startswith(MAGIC):
        return data[:HEADER.size]
    return zlib.decompressobj(zlib.MAX_WBITS | 16).decompress(data, HEADER.size)


def _header(data: bytes) -> _Header:
    magic, *numbers = HEADER.unpack(data)
    header = _Header(*numbers)
    if magic != MAGIC or header.version not in PLACE_BYTES:
        raise ValueError(f"versions {min(PLACE_BYTES)} to {max(PLACE_BYTES)} are read, not "
                         f"{header.version}" if magic == MAGIC else "its header is another")
    if header.degree > HIGHEST_DEGREE or header.bits > MOST_FRACTIONAL_BITS:
        raise ValueError(f"SH degree {header.degree}, {header.bits} fractional bits")
    return header


def _unpacked(data: bytes) -> _Content:
    """All parts of a file."""
    header = _header(_begin(data))
    widths = header.widths
    size = header.number * sum(widths)
    check_expansion(len(data), size)
    check_rows(len(data), header.number, widths[-1] // 3)
    if header.version == WITH_STREAMS and (header.streams or not header.number):
        contents = streams(data, header.streams, [header.number * width for width in widths],
                           bool(header.flags & EXTENDED))
    else:
        whole = _whole(data, size, header)
        ends = np.cumsum(header.number * np.array(widths, np.int64))
        contents = [whole[end - header.number * width:end] for end, width in zip(ends, widths)]
    return _Content(header.degree, header.bits, [
        np.frombuffer(part, np.uint8).reshape(header.number, width)
        for part, width in zip(contents, widths)])


def _whole(data: bytes, size: int, header: _Header) -> bytes:
    """The bytes after the header of a gzip stream, or of one that was unpacked on its way, as
    servers do that send it with the encoding gzip."""
    more = MOST_EXTENSION_BYTES if header.flags & EXTENDED else 0
    if data.startswith(MAGIC):
        content, ended = data[HEADER.size:], True
    else:
        stream = zlib.decompressobj(zlib.MAX_WBITS | 16)
        stream.decompress(data, HEADER.size)
        content = stream.decompress(stream.unconsumed_tail, size + more + 1)
        ended = stream.eof  # at the end its checksum was compared
    if not size <= len(content) <= size + more or not ended:
        raise ValueError(f"its {header.number} gaussians have another size")
    check_extensions(content[size:])
    return content[:size]


def _rows(content: _Content) -> dict[str, NDArray[np.float64]]:
    position, opacity, colour, scale, rotation, sh = content.parts
    count, bands = len(position), min(sh.shape[1] // 3, (KEPT_DEGREE + 1) ** 2 - 1)
    return half_turn({
        "positions": _positions(position, content.bits),
        "sh_constant": (colour / 255 - 0.5) / COLOUR_SCALE,
        "sh_rest": (sh[:, :3 * bands].reshape(count, bands, 3) - float(SH_STEPS)) / SH_STEPS,
        "opacity_logits": byte_logits(opacity[:, 0]),
        "log_scales": scale / SCALE_STEPS + SMALLEST_LOG_SCALE,
        "quaternions": _rotations(rotation),
    }, axis=0)


def _positions(data: NDArray[np.uint8], bits: int) -> NDArray[np.float64]:
    """Positions of 24 bits, or of version 1, which has numbers of half precision."""
    if data.shape[1] == HALF:
        return np.ascontiguousarray(data).view("<f2").astype(np.float64)
    fixed = np.zeros((len(data), 3, 4), np.uint8)
    fixed[..., 1:] = data.reshape(len(data), 3, 3)  # the upper bytes keep the sign
    values: NDArray[np.float64] = (fixed.view("<i4")[..., 0] >> 8) / 2.0**bits
    return values


def _fractional_bits(path: Path, positions: NDArray[np.float64], log_scales: NDArray[np.float32]
                     ) -> int:
    """The bits below one in 24: as many as the gaussians need, if the largest position fits."""
    if not len(positions):
        return 0
    largest = max(float(np.abs(positions).max()), SMALLEST_EXTENT)
    most = int(np.floor(np.log2(POSITION_LIMIT / largest)))
    if most < 0:
        raise InputError(f"{path}: SPZ holds positions below {POSITION_LIMIT:,}, and the farthest "
                         f"is at {largest:g}; remove what is so far away, or write another format")
    extent = max(float(np.ptp(positions, axis=0).max()), SMALLEST_EXTENT)
    needed = int(np.ceil(np.log2(max(FEWEST_STEPS / extent,
                                     np.exp(-float(np.median(log_scales))) / POSITION_STEP))))
    return min(most, max(needed, 0), MOST_FRACTIONAL_BITS)


def _sh_bytes(sh_rest: NDArray[np.float64]) -> NDArray[np.uint8]:
    bucket = np.where(np.arange(sh_rest.shape[1]) < 3, *SH_BUCKETS)[:, None]
    return to_bytes(np.clip(np.floor(sh_rest * SH_STEPS / bucket + 0.5) * bucket + SH_STEPS,
                            0, 255))


def _packed_rotations(quaternions: NDArray[np.float64]) -> NDArray[np.uint32]:
    """Two bits for the largest of x, y, z, w, then a sign and nine bits for each of the others."""
    largest, others = smallest_three(quaternions[:, XYZW])
    packed = largest.astype("<u4")
    for value in others.T:
        size = np.rint(np.abs(value) * np.sqrt(2) * 511).astype(np.uint32)
        packed = packed << 10 | (value < 0).astype(np.uint32) << 9 | np.minimum(size, 511)
    return packed.astype("<u4")


def _rotations(data: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Quaternions w, x, y, z from the three bytes of version 2 or the four of version 3."""
    if data.shape[1] == 3:
        others = data / 127.5 - 1
        w = np.sqrt(np.maximum(0, 1 - (others**2).sum(axis=1)))
        return np.column_stack([w, others])
    packed = np.ascontiguousarray(data).view("<u4")[:, 0]
    fields = np.stack([packed >> shift & 1023 for shift in (20, 10, 0)], axis=1).astype(np.int64)
    others = (fields & 511) * np.where(fields > 511, -1, 1) / (511 * np.sqrt(2))
    values: NDArray[np.float64] = from_smallest_three(packed >> 30, others)[:, np.argsort(XYZW)]
    return values


def _origin(data: bytes) -> NDArray[np.float64]:
    """What the comment of the gzip header records, or zero."""
    begin = len(GZIP_HEADER % 0)
    if data.startswith(MAGIC):
        return np.zeros(3)
    found = ORIGIN.fullmatch(data[begin:].partition(b"\0")[0]) if data[3] & COMMENT else None
    origin = np.array([float(value) for value in found.groups()]) if found else np.zeros(3)
    if not np.isfinite(origin).all():
        raise ValueError("its origin is not finite")
    return origin
