"""Files that hold more than they claim, or claim more than they hold: refused in little memory.

Each was read into memory as a whole, or as often as it named its content, by an earlier version.
"""

import json
import struct
import tracemalloc
import zipfile

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.io.models.formats import read_model, write_model
from clsplat.io.models.sog import encode_webp
from clsplat.io.npz import read_npz, write_npz
from tests.io.models.test_ply import random_gaussians

PAYLOAD = 1 << 26
LITTLE = 1 << 25


def refused(read, path, word, most=LITTLE):
    tracemalloc.start()
    with pytest.raises(InputError, match=word) as caught:
        read(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < most, f"{peak >> 20} MiB"
    assert path.name in str(caught.value) and "\n" not in str(caught.value)


def lying(path, members, claims, method=zipfile.ZIP_DEFLATED):
    """A zip whose headers claim other sizes than its members have."""
    with zipfile.ZipFile(path, "w", method, compresslevel=1) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
        for member in archive.filelist:
            member.file_size = claims.get(member.filename, member.file_size)
    return path


def sog_members(folder, count=3):
    write_model(folder / "small.sog", random_gaussians(count))
    with zipfile.ZipFile(folder / "small.sog") as archive:
        return {name: archive.read(name) for name in archive.namelist()}


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_members_without_a_limit_of_memory(tmp_path, method):
    members = sog_members(tmp_path) | {"meta.json": bytes(PAYLOAD)}
    refused(read_model, lying(tmp_path / "a.sog", members, {"meta.json": 100}, method),
            "another method than deflate")


def test_millions_of_gaussians_in_a_few_bytes(tmp_path):
    members = sog_members(tmp_path)
    meta = json.loads(members["meta.json"]) | {"count": 1 << 21}
    for name in members:
        if name.endswith(".webp"):
            members[name] = encode_webp(np.full((1024, 2048, 4), 252, np.uint8))
    members["meta.json"] = json.dumps(meta).encode()
    refused(read_model, lying(tmp_path / "a.sog", members, {}), "claim to hold", 1 << 26)


def test_primitives_of_a_glb_that_all_name_the_same_gaussians(tmp_path):
    path = tmp_path / "a.glb"
    write_model(path, random_gaussians(300))
    data = path.read_bytes()
    size, = struct.unpack_from("<I", data, 12)
    document = json.loads(data[20:20 + size])
    document["meshes"][0]["primitives"] *= 400
    text = json.dumps(document).encode()
    path.write_bytes(data[:12] + struct.pack("<I4s", len(text), b"JSON") + text + data[20 + size:])
    refused(read_model, path, "several meshes")


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_elements_of_a_ply_without_properties(tmp_path, form):
    path = tmp_path / "a.ply"
    path.write_bytes(f"ply\nformat {form} 1.0\nelement vertex 1000000000000\nend_header\n".encode())
    refused(read_model, path, "PLY")


ARRAYS = {"wide": np.arange(3000, dtype=np.float32).reshape(50, 4, 15),
          "flat": np.arange(50, dtype=np.uint32)}


@pytest.fixture
def path(tmp_path):
    with open(tmp_path / "arrays.npz", "wb") as file:
        write_npz(file, ARRAYS)
    return tmp_path / "arrays.npz"


@pytest.mark.parametrize("rows", [[], [0, 1, 24, 49], range(50)])
def test_some_rows_are_those_of_the_whole_array(path, rows):
    rows = np.array(rows, np.int64)
    found = read_npz(path, "damaged", "copy it again", rows=rows)
    assert set(found) == set(ARRAYS)
    for name, values in ARRAYS.items():
        assert found[name].dtype == values.dtype and np.array_equal(found[name], values[rows])


def test_damage_in_rows_that_are_left_out_is_found(path):
    content = bytearray(path.read_bytes())
    content[content.index(ARRAYS["wide"][30].tobytes())] ^= 1
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"damaged \(.*wide.*\); copy it again"):
        read_npz(path, "damaged", "copy it again", rows=np.array([2, 3]))
