"""Mega-NeRF folders are refused with a cure, and can be read once the example converted them."""

import json
import os
import subprocess
import sys

from clsplat.io.scenes.read import read_scene
from tests.data import layouts
from tests.data.tiny_training import ROOT
from tests.refusals import refused

HELD_OUT = {"004.jpg", "024.jpg"}  # the second and the seventh
# stands for PyTorch where that is not installed; metadata are JSON then
STUB = """import json
def load(path, map_location, weights_only):
    assert map_location == "cpu" and weights_only is True
    return json.load(open(path))
"""


def save_json(table, path):
    path.write_text(json.dumps(table, default=lambda value: value.tolist()))


def name(old):
    """A Mega-NeRF folder of every fourth photo of the city, numbered in order."""
    part = "val" if old in HELD_OUT else "train"
    return f"{part}/rgbs/{int(old[:3]) // 4:06d}.jpg"


def described(folder, stub):
    (stub / "torch.py").write_text(STUB)
    return subprocess.run(
        [sys.executable, ROOT / "docs/examples/from_mega_nerf.py", folder],
        check=True,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(stub)},
    ).stdout


def test_cameras_and_held_out_views(tmp_path, city):
    folder = tmp_path / "rubble"
    layouts.write_mega_nerf(folder, city, HELD_OUT, save_json)
    assert described(folder, tmp_path) == "train: 6 photos\nval: 2 photos\n"
    scene = read_scene(folder)
    layouts.assert_same_cameras(scene, city, name)
    assert scene.held_out == {name(old) for old in HELD_OUT}
    assert scene.path == folder and scene.name == "rubble" and len(scene.points) == 4000


def test_a_folder_that_is_not_converted_is_refused_with_the_command(tmp_path, city):
    layouts.write_mega_nerf(tmp_path, city, HELD_OUT, save_json)
    refused(lambda: read_scene(tmp_path), "a Mega-NeRF folder", "from_mega_nerf.py")
