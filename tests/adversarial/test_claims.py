"""Files whose headers claim more than the file holds: one line refuses each, in little memory.

Readers of libraries allocate what a header claims before they read the first byte behind it.
"""

import io
import struct
import tracemalloc
import zipfile

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.io.models.formats import read_model, write_model
from clsplat.io.npz import read_npz
from clsplat.io.photos.images import read_image, write_image
from clsplat.io.scenes.read import read_scene
from tests.data.tiny_model import write_scene
from tests.io.models.test_ply import random_gaussians

MOST_BYTES = 8 << 20  # that a refusal may allocate


def ply(form):
    def write(path):
        path.write_text(f"ply\nformat {form} 1.0\nelement vertex 1000000000000\nproperty float x\n"
                        "property list uchar float y\nend_header\n1 0\n")
    return write


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
    return read_npz(path, "damaged", "copy it again")


# name -> (file name, its writer, its reader)
CLAIMS = {
    "rows of a PLY": ("a.ply", ply("binary_little_endian"), read_model),
    "lines of a PLY": ("a.ply", ply("ascii"), read_model),
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


def refused(read, path, *words):
    """One line refuses a file, and little is allocated; it holds the words."""
    tracemalloc.start()
    try:
        with pytest.raises(InputError) as caught:
            read(path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    message = str(caught.value)
    assert peak < MOST_BYTES and len(message.splitlines()) == 1 and len(message) < 1000
    for word in (path.name, *words):
        assert word in message, message
