"""Meshes in files: what other programs read of them, and what cannot be written."""

import json
import struct

import numpy as np
import plyfile
import pytest

from clsplat.errors import InputError
from clsplat.georeference import Georeference
from clsplat.io.models.mesh import Mesh, write_mesh
from clsplat.io.models.values import Notes

PLACE = Georeference("EPSG:32633", (400_000.0, 5_700_000.0, 80.0), "made up", 0.1)
NOTES = Notes((), np.array([0.0, 0.0, 1.0]), PLACE)
CORNERS = np.array([[0, 0, 0], [1, 0, 0.25], [0, 2, 0], [0, 0, 3.0]])
COLOURS = np.array([[255, 0, 0], [0, 128, 0], [1, 2, 3], [255, 255, 255]], np.uint8)
TRIANGLES = np.array([[0, 2, 1], [0, 1, 3]], np.int32)


def mesh_at(away=0.0):
    return Mesh(CORNERS + away, COLOURS, TRIANGLES, 0.05)


@pytest.mark.parametrize("away, kind", [(0.0, "<f4"), (5e6, "<f8")])
def test_ply(tmp_path, away, kind):
    """Coordinates far from the origin need double precision."""
    write_mesh(tmp_path / "m.ply", mesh_at(away + 1e-3), NOTES)
    read = plyfile.PlyData.read(tmp_path / "m.ply")
    vertices = read["vertex"]
    assert vertices["x"].dtype == kind
    found = np.stack([vertices[axis] for axis in "xyz"], axis=1)
    assert abs(found - CORNERS - away - 1e-3).max() < 1e-5
    assert np.array_equal(np.stack([vertices[c] for c in ("red", "green", "blue")], 1), COLOURS)
    assert np.array_equal(np.vstack(read["face"]["vertex_indices"]), TRIANGLES)
    assert any("EPSG:32633" in line for line in read.comments)
    assert any("5700000" in line for line in read.comments)


def test_obj(tmp_path):
    write_mesh(tmp_path / "m.obj", mesh_at(5e6), NOTES)
    lines = (tmp_path / "m.obj").read_text().splitlines()
    rows = {kind: [line.split()[1:] for line in lines if line.startswith(kind + " ")] for kind in "vf#"}
    vertices = np.array(rows["v"], float)
    assert abs(vertices[:, :3] - CORNERS - 5e6).max() < 1e-3
    assert np.array_equal(np.rint(255 * vertices[:, 3:]), COLOURS)
    assert np.array_equal(np.array(rows["f"], int), TRIANGLES + 1)
    assert any("EPSG:32633" in " ".join(words) for words in rows["#"])


def test_glb(tmp_path):
    """Through its nodes, up is y and places are the original ones; colours are linear."""
    write_mesh(tmp_path / "m.glb", mesh_at(5e6), NOTES)
    data = (tmp_path / "m.glb").read_bytes()
    magic, version, length, size, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    document = json.loads(data[20 : 20 + size])
    content = data[28 + size :]

    def values(accessor, dtype, width):
        view = document["bufferViews"][document["accessors"][accessor]["bufferView"]]
        part = content[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        return np.frombuffer(part, dtype).reshape(-1, width)

    root, node = document["nodes"]
    places = values(0, "<f4", 3).astype(float) + node["translation"]
    assert abs(places - CORNERS - 5e6).max() < 1e-5
    x, y, z, w = root["rotation"]  # z to y: (x, y, z) becomes (x, z, -y)
    assert np.allclose([x, y, z, w], [-np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
    linear = values(1, "<u2", 4) / 65535
    assert np.allclose(linear[[0, 3]], [[1, 0, 0, 1], [1, 1, 1, 1]])
    assert linear[1, 1] == pytest.approx(0.2158605, abs=1e-4) and linear[2, 2] < 0.002
    assert np.array_equal(values(2, "<u4", 3), TRIANGLES)
    bounds = document["accessors"][0]
    assert np.allclose(bounds["min"], -np.array([0.5, 1, 1.5])) and "EPSG:32633" in str(
        document["asset"]["extras"]["comments"]
    )


def test_what_cannot_be_written(tmp_path):
    with pytest.raises(InputError, match=r"unknown suffix '.stl'; meshes are written as .glb"):
        write_mesh(tmp_path / "m.stl", mesh_at(), NOTES)
    with pytest.raises(InputError, match="cannot be written"):
        write_mesh(tmp_path / "missing" / "m.ply", mesh_at(), NOTES)
    assert not list(tmp_path.iterdir())
