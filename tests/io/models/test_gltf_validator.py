"""Khronos' validator finds no error in glTF that clsplat writes, but names that it does not know.

It is a Node package: `npm install gltf-validator@2.0.0-dev.3.10` somewhere, and name that folder in
CLSPLAT_NODE_MODULES. .ci/nightly does so. This version knows no splats: the names of their
attributes are the only ones with a colon, which it refuses; their number and accessors it checks.
"""

import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest

from clsplat.io.models.formats import write_model
from clsplat.io.models.gltf import EXTENSION, write_spz_glb
from clsplat.io.models.mesh import write_mesh
from tests.io.models.test_formats import model
from tests.io.models.test_mesh import NOTES, mesh_at

SCRIPT = """
const validator = require(process.argv[1] + "/node_modules/gltf-validator");
validator.validateBytes(new Uint8Array(require("fs").readFileSync(process.argv[2]))).then(
    report => console.log(JSON.stringify(report.issues)));
"""
ERROR, WARNING = 0, 1

pytestmark = pytest.mark.slow


@pytest.fixture
def complaints():
    """A function of a file: the codes and places of its errors and warnings."""
    node, folder = shutil.which("node"), os.environ.get("CLSPLAT_NODE_MODULES", "")
    if node is None:
        pytest.skip("node is not installed: apt-get install nodejs")
    if not (Path(folder) / "node_modules/gltf-validator").is_dir() or not folder:
        pytest.skip("CLSPLAT_NODE_MODULES names no folder in which `npm install gltf-validator@2.0.0-dev.3.10` was run")

    def run(path):
        done = subprocess.run(
            [node, "-e", SCRIPT, folder, path], capture_output=True, text=True, timeout=100, check=True
        )
        found = json.loads(done.stdout)
        assert not found["truncated"]
        return [(each["code"], each["pointer"]) for each in found["messages"] if each["severity"] in (ERROR, WARNING)]

    return run


def unknown(found):
    """Those that are not about the name of an attribute of splats."""
    return [
        each
        for each in found
        if each[0] != "MESH_PRIMITIVE_INVALID_ATTRIBUTE" or f"/attributes/{EXTENSION}:" not in each[1]
    ]


@pytest.mark.parametrize("count, degree, named", [(0, 0, 0), (40, 0, 4), (40, 3, 19)])
def test_splats(tmp_path, complaints, count, degree, named):
    write_model(tmp_path / "a.glb", model(count, degree), up=(0, 0.6, 0.8))
    found = complaints(tmp_path / "a.glb")
    assert len(found) == named and not unknown(found)


def test_tiles(tmp_path, complaints):
    write_spz_glb(tmp_path / "a.glb", model(40, 3))
    found = complaints(tmp_path / "a.glb")
    assert found and not unknown(found)


def test_meshes(tmp_path, complaints):
    write_mesh(tmp_path / "a.glb", mesh_at(), NOTES)
    assert complaints(tmp_path / "a.glb") == []


def test_it_finds_what_is_wrong(tmp_path, complaints):
    write_model(tmp_path / "a.glb", model(40, 1))
    content = (tmp_path / "a.glb").read_bytes()
    (tmp_path / "a.glb").write_bytes(content.replace(b'"count":40', b'"count":41', 1))
    assert unknown(complaints(tmp_path / "a.glb"))
