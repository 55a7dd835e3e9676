"""Binary glTF whose gaussians are SPZ, as 3D Tiles have them."""

import json
import struct

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.io.models.formats import read_model
from clsplat.io.models.gltf import write_spz_glb
from tests.io.models.test_formats import BOUNDS, compare, model


def parts(path):
    """The document of a binary glTF and its buffer."""
    data = path.read_bytes()
    size, = struct.unpack_from("<I", data, 12)
    return json.loads(data[20:20 + size]), data[28 + size:]


def changed(path, document, content):
    text = json.dumps(document).encode()
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 0) + struct.pack("<I4s", len(text), b"JSON")
                     + text + struct.pack("<I4s", len(content), b"BIN\0") + content)


@pytest.mark.parametrize("count, degree", [(1, 0), (200, 0), (200, 3)])
def test_what_is_written_is_read_back(tmp_path, count, degree):
    path, gaussians = tmp_path / "a.glb", model(count, degree)
    write_spz_glb(path, gaussians)
    compare(read_model(path), gaussians, BOUNDS[".spz"])
    moved = read_model(path, (1.0, 2.0, 3.0))
    assert np.array_equal(moved.offset, (1, 2, 3))
    compare(moved, gaussians, BOUNDS[".spz"])


def test_another_place_of_the_buffer_and_damage(tmp_path):
    path, gaussians = tmp_path / "a.glb", model(40, 1)
    write_spz_glb(path, gaussians)
    document, content = parts(path)
    view = document["bufferViews"][0]
    changed(path, {**document, "bufferViews": [{**view, "byteOffset": 8}]}, bytes(8) + content)
    compare(read_model(path), gaussians, BOUNDS[".spz"])
    for change in ({"byteOffset": 8}, {"byteOffset": -1}, {"byteLength": 30}, {"buffer": 1}):
        changed(path, {**document, "bufferViews": [{**view, **change}]}, content)
        with pytest.raises(InputError, match="a.glb: not a binary glTF") as caught:
            read_model(path)
        assert "\n" not in str(caught.value)
    turned = {**document["nodes"][0], "name": "of another program"}
    changed(path, {**document, "nodes": [turned]}, content)
    with pytest.raises(InputError, match="a node turns or scales its gaussians"):
        read_model(path)
