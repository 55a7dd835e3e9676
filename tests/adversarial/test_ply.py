"""PLY files as other programs write them, and as nobody should."""

import pytest

from clsplat.errors import InputError
from clsplat.io.models.ply import read_vertices

PLY = (b"ply\nformat ascii 1.0\n%selement vertex 2\nproperty float x\nproperty float y\n"
       b"property float z\nend_header\n1 2 3\n4 5 6\n")


@pytest.mark.parametrize("comment", [
    "comment Aufnahme: Köln\n".encode(), "comment Köln\n".encode("latin-1"),
    b"comment " + bytes(range(14, 256)) + b"\n", b"comment end_header\n",
    b"comment " + b"x" * 500_000 + b"\n"])
def test_ply_with_any_comment(tmp_path, comment):
    (tmp_path / "a.ply").write_bytes(PLY % comment)
    element, _ = read_vertices(tmp_path / "a.ply")
    assert element.data["z"].tolist() == [3, 6]


@pytest.mark.parametrize("content", [
    b"", b"ply", b"ply\n", b"ply\r", b"ply\n" * 10**6, b"ply\n" + bytes(5 << 20),
    b"plyformat ascii 1.0\nend_header\n", b"ply\nend_header\n",
    PLY % b"element vertex 99999999999\n", PLY % b"element vertex -1\n",
    PLY % b"element vertex 1e3\n", PLY % b"format ascii 1.0\n", PLY % b"property list\n",
    (PLY % b"").replace(b"float", b"\xfcoat"), (PLY % b"").replace(b"4 5", b"four 5"),
    (PLY % b"").replace(b"vertex", b"face")])
def test_ply_that_is_none(tmp_path, content):
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(InputError, match="a.ply") as caught:
        read_vertices(tmp_path / "a.ply")
    assert "\n" not in str(caught.value) and ";" in str(caught.value)
