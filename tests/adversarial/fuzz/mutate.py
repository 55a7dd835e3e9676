"""Seeded mutations of the bytes of a valid file: `mutated` chooses, the rest are the ways.

Each way takes a `random.Random`, the bytes, and those of another valid file to splice with. Where a
format guards its content by checksums, the content is mutated too and the checksums are made to
fit: else nothing behind them would ever be reached.
"""

import gzip
import io
import itertools
import re
import zipfile
import zlib

import numpy as np

INTEGERS = (
    0,
    1,
    -1,
    127,
    128,
    255,
    2**15,
    2**16 - 1,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**40,
    10**12,
    2**63 - 1,
    2**63,
    2**64 - 1,
)
FLOATS = (0.0, -0.0, -1.0, float("nan"), float("inf"), -float("inf"), 1e-320, 1e-45, 1e38, 1e300, 2.0**31, 2.0**63)
WORDS = (
    b"",
    b"0",
    b"-1",
    b"nan",
    b"NaN",
    b"inf",
    b"-Infinity",
    b"2147483648",
    b"4294967295",
    b"9223372036854775808",
    b"1000000000000",
    b"1e300",
    b"1e400",
    b"0x10",
    b"true",
    b"null",
    b"[]",
    b"{}",
    b"''",
    b'"text"',
    b"9" * 5000,
    b"[" * 3000,
    b"\xff\xfe",
    b"\0",
    b"..",
    b"/etc",
    "\u2028é".encode(),
    b"\\ud800",
    b"a\\nb",
)
NUMBER = re.compile(rb"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
FIELD = re.compile(rb"[^\s,:=\[\]{}\"]+")
GZIP_MAGIC, GLB_MAGIC, SPZ_MAGIC = b"\x1f\x8b", b"glTF", b"NGSP"


def mutated(random, data, other, text=False):
    """`data` after one to three mutations; text: of its lines and fields most of the time."""
    for _ in range(random.choice((1, 1, 1, 2, 3))):
        if zipfile.is_zipfile(io.BytesIO(data)) and random.random() < 0.8:
            data = _inside_zip(random, data, other)
        elif data.startswith(GZIP_MAGIC) and random.random() < 0.8:
            data = _inside_gzip(random, data)
        elif data.startswith(GLB_MAGIC) and random.random() < 0.6:
            data = _inside_glb(random, data)
        elif data.startswith(SPZ_MAGIC) and random.random() < 0.6:
            data = _inside_spz(random, data)
        else:
            ways = LINES if text and random.random() < 0.75 else BYTES
            data = random.choice(ways)(random, data, other)
    return data


def _span(random, data, longest=64):
    """(begin, end) of a run of bytes, mostly a short one."""
    begin = random.randrange(len(data) + 1)
    return begin, min(len(data), begin + random.choice((1, 2, 4, 8, random.randint(1, longest))))


def flip_bits(random, data, other):
    data = bytearray(data)
    for _ in range(random.choice((1, 1, 2, 8)) if data else 0):
        data[random.randrange(len(data))] ^= 1 << random.randrange(8)
    return bytes(data)


def fill(random, data, other):
    begin, end = _span(random, data)
    return data[:begin] + random.choice((b"\0", b"\xff", b" ", b"\n", b"9")) * (end - begin) + data[end:]


def truncate(random, data, other):
    return data[: random.randrange(len(data) + 1)]


def insert(random, data, other):
    begin, end = _span(random, data)
    return data[:begin] + random.randbytes(end - begin) + data[begin:]


def remove(random, data, other):
    begin, end = _span(random, data)
    return data[:begin] + data[end:]


def splice(random, data, other):
    return data[: random.randrange(len(data) + 1)] + other[random.randrange(len(other) + 1) :]


def number(random, data, other):
    """An extreme value over some bytes, most often where a multiple of 4 begins or in the head."""
    if random.random() < 0.3:
        with np.errstate(over="ignore"):
            value = np.array(random.choice(FLOATS)).astype(random.choice(("<f4", "<f8"))).tobytes()
    else:
        width = random.choice((1, 2, 4, 8))
        value = (random.choice(INTEGERS) % 256**width).to_bytes(width, random.choice(("little", "little", "big")))
    begin = random.randrange(min(len(data), random.choice((64, 1 << 20))) + 1)
    return data[:begin] + value + data[begin + len(value) :]


BYTES = (flip_bits, fill, truncate, insert, remove, splice, number, number)


def _replace_one(random, pattern, data, value):
    """`data` with one of the pattern's matches replaced."""
    found = list(pattern.finditer(data, random.randrange(len(data) + 1))) or list(pattern.finditer(data))
    if not found:
        return data + value
    match = random.choice(found[:200])
    return data[: match.start()] + value + data[match.end() :]


def text_number(random, data, other):
    return _replace_one(random, NUMBER, data, random.choice(WORDS))


def field(random, data, other):
    return _replace_one(random, FIELD, data, random.choice(WORDS))


def lines(random, data, other):
    """A line removed, repeated, moved, or taken from the other file."""
    rows = data.splitlines(keepends=True) or [b""]
    at, to = random.randrange(len(rows)), random.randrange(len(rows))
    match random.randrange(5):
        case 0:
            del rows[at]
        case 1:
            rows.insert(to, rows[at])
        case 2:
            rows[at], rows[to] = rows[to], rows[at]
        case 3:
            rows[at] = random.choice(other.splitlines(keepends=True) or [b"\n"])
        case 4:
            rows[at] = rows[at].rstrip(b"\r\n")
    return b"".join(rows)


LINES = (text_number, text_number, field, lines)


def _inside_gzip(random, data):
    """The content of a gzip stream mutated, its length and checksum made to fit."""
    try:
        content = gzip.decompress(data)
    except (OSError, EOFError, zlib.error):  # an earlier mutation hit it
        return data
    return gzip.compress(random.choice(BYTES)(random, content, content[::-1]), 1, mtime=0)


def _inside_spz(random, data):
    """The content of a stream of SPZ 4 mutated, the table made to fit."""
    import zstandard

    try:
        at = int.from_bytes(data[16:20], "little")
        table = np.frombuffer(data[at : at + 16 * data[15]], "<u8").reshape(-1, 2)
        begins = list(itertools.accumulate(table[:, 0].tolist(), initial=at + table.nbytes))
        parts = [data[begin:end] for begin, end in itertools.pairwise(begins)]
        one = random.randrange(len(parts))
        content = zstandard.ZstdDecompressor().decompress(parts[one], 1 << 20)
    except (ValueError, IndexError, OverflowError, MemoryError, zstandard.ZstdError):
        return data  # an earlier mutation hit it
    content = random.choice(BYTES)(random, content, content[::-1])
    parts[one] = zstandard.ZstdCompressor(1).compress(content)
    sizes = table.copy()
    sizes[one] = len(parts[one]), len(content)
    return data[:at] + sizes.tobytes() + b"".join(parts)


def _inside_glb(random, data):
    """The JSON of a binary glTF mutated as text, its lengths made to fit."""
    if len(data) < 20:
        return data
    size = int.from_bytes(data[12:16], "little")
    text = random.choice(LINES)(random, data[20 : 20 + size], b"{}")
    text += b" " * (-len(text) % 4)
    rest = data[20 + size :]
    return (
        data[:8]
        + (20 + len(text) + len(rest)).to_bytes(4, "little")
        + len(text).to_bytes(4, "little")
        + data[16:20]
        + text
        + rest
    )


def _members(data):
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return {name: archive.read(name) for name in archive.namelist()}
    except Exception:  # an earlier mutation hit it
        return {}


def _inside_zip(random, data, other):
    """A member of a zip changed, its checksum made to fit; sometimes compressed."""
    members = _members(data)
    if not members:
        return data
    name = random.choice(list(members))
    way = random.randrange(6)
    if way == 0:
        del members[name]
    elif way == 1:
        members[random.choice(("", "../up.npy", "a\nb", name * 2))] = members.pop(name)
    elif way == 2:
        members[name] = random.choice([*_members(other).values(), *members.values()])
    elif way == 3:
        members[name] = random.choice(BYTES)(random, members[name], b"\0" * 64)
    else:
        members[name] = random.choice(LINES)(random, members[name], members[name])
    out = io.BytesIO()
    with zipfile.ZipFile(
        out, "w", random.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)), compresslevel=1
    ) as archive:
        for member, content in members.items():
            archive.writestr(zipfile.ZipInfo(member), content)
    return out.getvalue()
