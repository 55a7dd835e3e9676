"""SPZ of version 4 with its streams of Zstandard, beside a file as its README has it."""

import gzip
import struct
import sys
import tracemalloc

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.io.models.formats import count_of, read_model, read_with_notes, write_model
from clsplat.io.models.values import MIP
from tests.io.models.test_formats import BOUNDS, compare, model
from tests.io.models.test_ply import UTM, equal, random_gaussians
from tests.refusals import refused

zstandard = pytest.importorskip("zstandard", reason="an extra: pip install 'clsplat[spz]'")
NO_ZSTD = "SPZ of version 4 needs zstandard; `pip install zstandard`"


def parts_of(folder, count, degree):
    """The parts of a SPZ of version 3 that clsplat wrote, and its header."""
    write_model(folder / "v3.spz", random_gaussians(count, degree))
    data = gzip.decompress((folder / "v3.spz").read_bytes())
    widths = (9, 1, 3, 3, 4, 3 * ((degree + 1) ** 2 - 1))
    ends = 16 + np.cumsum([count * width for width in widths])
    return data[:16], [data[end - count * width : end] for end, width in zip(ends, widths)]


def version_4(
    folder, count=7, degree=3, *, extra=b"", flags=0, change=lambda table: table, number=None, fourth=False, frames=None
):
    """Write a file of version 4, as its README has it."""
    head, parts = parts_of(folder, count, degree)
    if fourth:
        rows = np.frombuffer(parts[5], np.uint8).reshape(count, 45)
        parts[5] = np.pad(rows, ((0, 0), (0, 27)), constant_values=77).tobytes()
    parts = [part for part in parts if part]
    packed = frames or [zstandard.ZstdCompressor(level=12).compress(part) for part in parts]
    table = change([(len(p), len(part)) for p, part in zip(packed, parts)])
    header = struct.pack(
        "<4sIIBBBBI12x",
        b"NGSP",
        4,
        count,
        4 if fourth else degree,
        head[13],
        flags,
        len(parts) if number is None else number,
        32 + len(extra),
    )
    path = folder / "v4.spz"
    path.write_bytes(header + extra + b"".join(struct.pack("<QQ", *row) for row in table) + b"".join(packed))
    return path


@pytest.mark.parametrize("count, degree", [(7, 3), (40, 1), (0, 0)])
def test_version_4_holds_what_version_3_does(tmp_path, count, degree):
    path = version_4(tmp_path, count, degree, flags=1)
    assert equal(read_model(path), read_model(tmp_path / "v3.spz"))
    assert count_of(path) == count and read_with_notes(path)[1].antialiased
    write_model(tmp_path / "w.spz", random_gaussians(count, degree), (MIP,), spz_version=4)
    assert (tmp_path / "w.spz").read_bytes() == path.read_bytes()


@pytest.mark.parametrize("offset", [(0, 0, 0), UTM])
def test_round_trip(tmp_path, offset):
    """Far from the origin, the origin of the positions stands before the table."""
    made = model(offset=offset)
    write_model(tmp_path / "a.spz", made, spz_version=4)
    bounds = list(BOUNDS[".spz"])
    bounds[0] = 1e-7 * any(offset)
    compare(read_model(tmp_path / "a.spz"), made, bounds)
    assert np.array_equal(read_model(tmp_path / "a.spz").offset, offset)
    data = (tmp_path / "a.spz").read_bytes()
    assert (b"origin_of_positions 5" in data, data[14] & 2) == (any(offset), 0)


def frame(content):
    """A frame that does not state its size."""
    packer = zstandard.ZstdCompressor(write_content_size=False).compressobj()
    return packer.compress(content) + packer.flush()


@pytest.mark.parametrize(
    "options, words",
    [
        ({"number": 255}, "table of 255 streams"),
        ({"change": lambda t: [(1 << 60, 63), *t[1:]]}, "more or less"),
        ({"change": lambda t: [(t[0][0], 1 << 50), *t[1:]]}, "claims to hold 1125899906842624"),
        ({"flags": 2, "extra": struct.pack("<II", 0x12340001, 0)}, "extensions are not read"),
        ({"fourth": True}, "SH degree 4"),
        ({"frames": 6 * [b"no Zstandard"]}, "damaged"),
        ({"frames": 6 * [frame(bytes(1 << 26))]}, "more or less"),
    ],
)
def test_damage(tmp_path, options, words):
    path = version_4(tmp_path, **options)
    tracemalloc.start()
    with pytest.raises(InputError, match=rf"v4\.spz: .*{words}"):
        read_model(path)
    assert tracemalloc.get_traced_memory()[1] < 1 << 22
    tracemalloc.stop()


def test_other_versions_are_named(tmp_path):
    data = bytearray(version_4(tmp_path).read_bytes())
    data[4:8] = struct.pack("<I", 5)
    for content in (data, gzip.compress(data)):
        (tmp_path / "a.spz").write_bytes(content)
        with pytest.raises(InputError, match="versions 2 to 4 are read, not 5"):
            read_model(tmp_path / "a.spz")


def test_the_library_that_is_missing_is_named(tmp_path, monkeypatch):
    path = version_4(tmp_path)
    monkeypatch.setitem(sys.modules, "zstandard", None)
    assert refused(lambda: read_model(path)) == f"{path}: {NO_ZSTD}"
    new = tmp_path / "new.spz"
    assert refused(lambda: write_model(new, model(), spz_version=4)) == f"{new}: {NO_ZSTD}"
    assert not new.exists()
