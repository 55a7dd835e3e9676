"""Files whose headers claim more than the file holds: one line refuses each, in little memory.

Readers of libraries allocate what a header claims before they read the first byte behind it.
"""

import io
import json
import struct
import tracemalloc
import zipfile

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.io.fields import reading
from clsplat.io.models.formats import read_model, write_model
from clsplat.io.models.sog import encode_webp
from clsplat.io.npz import read_npz, write_npz
from clsplat.io.photos.images import read_image, write_image
from clsplat.io.scenes.read import read_scene
from tests.data.tiny_model import write_scene
from tests.io.models.test_ply import random_gaussians

MOST_BYTES = 8 << 20  # that a refusal may allocate
PAYLOAD, LITTLE = 1 << 26, 1 << 25  # of what is unpacked, and that its refusal may allocate


def ply(form, properties="property float x\nproperty list uchar float y\n", rows="1 0\n"):
    def write(path):
        path.write_text(f"ply\nformat {form} 1.0\nelement vertex 1000000000000\n{properties}end_header\n{rows}")

    return write


def refused(read, path, *words, most=MOST_BYTES):
    """One line refuses a file, and little is allocated; it holds the words."""
    tracemalloc.start()
    try:
        with pytest.raises(InputError) as caught:
            read(path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    message = str(caught.value)
    assert peak < most and len(message.splitlines()) == 1 and len(message) < 1000
    for word in (path.name, *words):
        assert word in message, message


def jpeg(side):
    def write(path):
        write_image(path, np.zeros((8, 8, 3), np.uint8))
        data = bytearray(path.read_bytes())
        struct.pack_into(">HH", data, data.index(b"\xff\xc0") + 5, side, side)
        path.write_bytes(data)

    return write


def npz(old, new):
    """An array of 30 x 3 whose header was changed in place."""

    def write(path):
        np.save(member := io.BytesIO(), np.zeros((30, 3)))
        assert old in member.getvalue() and len(old) == len(new)
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("xyz.npy", member.getvalue().replace(old, new))

    return write


def zip_of_gigabytes(path):
    """The directory of a zip claims that a member has 2 GiB."""
    write_model(path, random_gaussians(6, 0))
    data = bytearray(path.read_bytes())
    for place in (20, 24):
        struct.pack_into("<L", data, data.index(b"PK\1\2") + place, 2**31 - 1)
    path.write_bytes(data)


def changed(write, place, form, value):
    """A file in which one number was overwritten."""

    def spoil(path):
        write(path)
        data = bytearray(path.read_bytes())
        struct.pack_into(form, data, place, value)
        path.write_bytes(data)

    return spoil


def model(path):
    write_model(path, random_gaussians(300, 0))


def arrays(path):
    with reading(path, "an npz"):
        return read_npz(path)


# name -> (file name, its writer, its reader)
CLAIMS = {
    "rows of a PLY": ("a.ply", ply("binary_little_endian"), read_model),
    "lines of a PLY": ("a.ply", ply("ascii"), read_model),
    "rows without columns": ("a.ply", ply("binary_little_endian", "", ""), read_model),
    "lines without columns": ("a.ply", ply("ascii", "", ""), read_model),
    "pixels of a JPEG": ("a.jpg", jpeg(4000), read_image),
    "more pixels than OpenImageIO takes": ("a.jpg", jpeg(60000), read_image),
    "rows of an array": ("a.npz", npz(b"(30, 3), }" + b" " * 11, b"(1000000000000, 3), }"), arrays),
    "fewer rows than there are": ("a.npz", npz(b"(30, 3)", b"(10, 3)"), arrays),
    "objects, which a pickle would make": ("a.npz", npz(b"'<f8'", b"'|O' "), arrays),
    "bytes of a member of a zip": ("a.sog", zip_of_gigabytes, read_model),
    "points of a LAS": ("a.las", changed(model, 247, "<Q", 10**12), read_model),
    "points of a LAZ": ("a.laz", changed(model, 247, "<Q", 10**12), read_model),
    "length of the JSON of a glTF": ("a.glb", changed(model, 12, "<I", 2**32 - 4), read_model),
}


@pytest.mark.parametrize("case", CLAIMS)
def test_a_claim_is_compared_with_the_file(tmp_path, case):
    name, write, read = CLAIMS[case]
    if name.endswith((".las", ".laz")):
        pytest.importorskip("laspy", reason="laspy is an extra: pip install 'clsplat[geo]'")
    write(tmp_path / name)
    refused(read, tmp_path / name)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_counts_of_a_colmap_model(tmp_path, name):
    folder = write_scene(tmp_path / "town")
    changed(lambda path: None, 0, "<Q", 10**12)(folder / f"sparse/0/{name}.bin")
    refused(read_scene, folder, f"{name}.bin")


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


@pytest.mark.slow
@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
@pytest.mark.one_in(2)
def test_members_without_a_limit_of_memory(tmp_path, method):
    members = sog_members(tmp_path) | {"meta.json": bytes(PAYLOAD)}
    refused(
        read_model,
        lying(tmp_path / "a.sog", members, {"meta.json": 100}, method),
        "another method than deflate",
        most=LITTLE,
    )


def test_millions_of_gaussians_in_a_few_bytes(tmp_path):
    members = sog_members(tmp_path)
    meta = json.loads(members["meta.json"]) | {"count": 1 << 21}
    for name in members:
        if name.endswith(".webp"):
            members[name] = encode_webp(np.full((1024, 2048, 4), 252, np.uint8))
    members["meta.json"] = json.dumps(meta).encode()
    refused(read_model, lying(tmp_path / "a.sog", members, {}), "claim to hold", most=1 << 26)


def test_primitives_of_a_glb_that_all_name_the_same_gaussians(tmp_path):
    path = tmp_path / "a.glb"
    write_model(path, random_gaussians(300))
    data = path.read_bytes()
    (size,) = struct.unpack_from("<I", data, 12)
    document = json.loads(data[20 : 20 + size])
    document["meshes"][0]["primitives"] *= 400
    text = json.dumps(document).encode()
    path.write_bytes(data[:12] + struct.pack("<I4s", len(text), b"JSON") + text + data[20 + size :])
    refused(read_model, path, "several meshes", most=LITTLE)


ARRAYS = {"wide": np.arange(3000, dtype=np.float32).reshape(50, 4, 15), "flat": np.arange(50, dtype=np.uint32)}


@pytest.fixture
def path(tmp_path):
    with open(tmp_path / "arrays.npz", "wb") as file:
        write_npz(file, ARRAYS)
    return tmp_path / "arrays.npz"


def test_damage_in_an_array_is_found(path):
    content = bytearray(path.read_bytes())
    content[content.index(ARRAYS["wide"][30].tobytes())] ^= 1
    path.write_bytes(content)
    with pytest.raises(ValueError, match="wide"):
        read_npz(path)
