"""PlayCanvas' splat-transform reads what clsplat writes: the same positions, colours and axes.

It is a Node package: `npm install @playcanvas/splat-transform@2.7.1` somewhere, and name that
folder in CLSPLAT_NODE_MODULES. .ci/nightly does so.
"""

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from clsplat.io.models.formats import read_model, write_model
from tests.io.models.test_formats import BOUNDS, compare, model, parts, turns, world
from tests.io.models.test_ply import UTM

COMMAND = "node_modules/@playcanvas/splat-transform/bin/cli.mjs"

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def convert():
    """A function that converts one file into another with splat-transform."""
    node, folder = shutil.which("node"), os.environ.get("CLSPLAT_NODE_MODULES", "")
    command = Path(folder) / COMMAND
    if node is None:
        pytest.skip("node is not installed: apt-get install nodejs")
    if not folder or not command.is_file():
        pytest.skip(
            "CLSPLAT_NODE_MODULES names no folder in which `npm install @playcanvas/splat-transform@2.7.1` was run"
        )

    def run(source, target, version="3"):
        done = subprocess.run(
            [node, command, "-q", "-w", "-g", "cpu", "--spz-version", version, source, target],
            capture_output=True,
            text=True,
            timeout=300,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return target

    return run


def uneven(degree):
    """A model that no turn and no mirror maps to itself, in an order that no format keeps."""
    made = model(400, degree)
    made.positions[:] *= (1, 2, 4)
    made.positions[:, 0] += 3
    return made


@pytest.mark.parametrize("suffix, version", [(".ply", 0), (".sog", 0), (".spz", 3), (".spz", 4)])
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_it_reads_what_we_write(tmp_path, convert, suffix, version, degree):
    if version == 4:
        pytest.importorskip("zstandard", reason="an extra: pip install '.[spz]'")
    gaussians = uneven(degree)
    write_model(tmp_path / f"a{suffix}", gaussians, spz_version=version)
    found = read_model(convert(tmp_path / f"a{suffix}", tmp_path / "found.ply"))
    bounds = list(BOUNDS[suffix])
    bounds[2] = max(1.5 * bounds[2], 1e-3)  # it normalises quaternions
    compare(found, gaussians, bounds)
    # what it decodes is what we decode, far within the steps of the format
    ours = read_model(tmp_path / f"a{suffix}")
    compare(found, ours, (1e-6, 1e-5, 2e-3, 1e-5, 2e-3, 1e-5))


def test_it_skips_the_origin_of_version_4(tmp_path, convert):
    """Which stands before the table, without a flag; it reads the local coordinates."""
    pytest.importorskip("zstandard", reason="an extra: pip install '.[spz]'")
    gaussians = uneven(1)
    write_model(tmp_path / "a.spz", gaussians.located(UTM), spz_version=4)
    found = read_model(convert(tmp_path / "a.spz", tmp_path / "found.ply"))
    compare(found, gaussians, (*BOUNDS[".spz"][:2], 0.015, *BOUNDS[".spz"][3:]))


@pytest.mark.parametrize("suffix, version", [(".sog", "3"), (".spz", "3"), (".spz", "4"), (".glb", "3")])
def test_we_read_what_it_writes(tmp_path, convert, suffix, version):
    if version == "4":
        pytest.importorskip("zstandard", reason="an extra: pip install '.[spz]'")
    gaussians = uneven(2)
    write_model(tmp_path / "a.ply", gaussians)
    found = read_model(convert(tmp_path / "a.ply", tmp_path / f"b{suffix}", version))
    bounds = list(BOUNDS[suffix])
    bounds[0] = max(bounds[0], 1e-3)
    bounds[2], bounds[4], bounds[5] = 2 * bounds[2], 1 / 255, 2 * bounds[5]  # it rounds down
    if suffix == ".sog":  # its palette has few entries, which it chooses at random
        bounds[5] = None
        _, match = cKDTree(world(found)).query(world(gaussians))
        difference = found.sh_rest[match] - gaussians.sh_rest
        assert np.sqrt(np.mean(difference**2)) < 0.5 * np.sqrt(np.mean(gaussians.sh_rest**2))
    compare(found, gaussians, bounds)


def glb_attributes(path):
    """Name -> array of the attributes of the first primitive of a file."""
    document, content = parts(path)
    primitive = document["meshes"][0]["primitives"][0]
    found = {}
    for name, number in primitive["attributes"].items():
        accessor = document["accessors"][number]
        start = document["bufferViews"][accessor["bufferView"]]["byteOffset"]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        kind = {5121: np.uint8, 5126: np.float32}[accessor["componentType"]]
        found[name] = np.frombuffer(content, kind, width * accessor["count"], start).reshape(-1, width)
    return found, primitive["extensions"]


def test_our_gltf_is_its_gltf(tmp_path, convert):
    """splat-transform writes glTF but does not read it: so both write one, and are compared."""
    gaussians = uneven(3)
    gaussians.quaternions[:] /= np.linalg.norm(gaussians.quaternions, axis=1, keepdims=True)
    write_model(tmp_path / "a.ply", gaussians)
    write_model(tmp_path / "a.glb", gaussians)
    theirs, extensions = glb_attributes(convert(tmp_path / "a.ply", tmp_path / "b.glb"))
    ours, our_extensions = glb_attributes(tmp_path / "a.glb")
    assert set(ours) == set(theirs) and our_extensions == extensions
    for name, values in theirs.items():
        if name.endswith("ROTATION"):
            assert turns(np.roll(ours[name], 1, 1), np.roll(values, 1, 1)).max() < 1e-3
        else:
            tolerance = 1 if name == "COLOR_0" else 1e-5
            assert np.abs(ours[name].astype(float) - values).max() <= tolerance, name
