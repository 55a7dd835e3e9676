"""CityGS's data sets: COLMAP folders train/ and val/ in one world become one scene."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from clsplat.io.scenes.read import read_scene
from tests.data import layouts
from tests.data.tiny_model import reconstruction, write_scene
from tests.refusals import refused

HELD_OUT = {"000.jpg", "012.jpg", "028.jpg"}


def name(old):
    return f"val/{old}" if old in HELD_OUT else f"train/{old}"


@pytest.mark.parametrize("photos", ["images", "rgbs"])
def test_both_parts_share_one_world(tmp_path, city, photos):
    layouts.write_citygs(tmp_path, city, HELD_OUT, photos)
    scene = read_scene(tmp_path)
    layouts.assert_same_cameras(scene, city, name)
    np.testing.assert_allclose(layouts.world_points(scene), layouts.world_points(city), atol=1e-9)
    assert np.array_equal(scene.colours, city.colours)
    assert scene.held_out == {f"val/{old}" for old in HELD_OUT}
    assert scene.path == tmp_path and scene.name == tmp_path.name
    train, test = scene.split(8)
    assert len(train) == 5 and {view.name for view in test} == scene.held_out
    assert scene.split(0) == (scene.views, ())

    def pairs(scene):
        return {(point, Path(scene.views[view].name).name) for point, view in scene.observations}

    assert pairs(scene) == {pair for pair in pairs(city) if pair[1] not in HELD_OUT}


def test_val_needs_no_points(tmp_path):
    tiny(tmp_path)
    (tmp_path / "val/sparse/0/points3D.bin").write_bytes(bytes(8))
    assert len(read_scene(tmp_path).points) == 30
    (tmp_path / "train/sparse/0/points3D.bin").write_bytes(bytes(8))
    refused(lambda: read_scene(tmp_path), "train", "holds no points3D")


def tiny(folder):
    """train/ and val/ of the four photos of the tiny model."""
    made = reconstruction()
    for part in ("train", "val"):
        for image in made.images.values():
            image.name = f"{part}_{image.name[-5:]}"
        write_scene(folder / part, made)
    return folder


@pytest.mark.parametrize(
    "spoil, words",
    [
        (lambda f: shutil.rmtree(f / "val"), "val: missing beside train/.*give .*train"),
        (lambda f: shutil.rmtree(f / "val/sparse"), "val: no COLMAP model"),
        (lambda f: (f / "val/images/val_2.png").unlink(), "val/images/val_2.png: no such image"),
    ],
)
def test_unusable_scenes(tmp_path, spoil, words):
    folder = tiny(tmp_path / "town")
    assert len(read_scene(folder).views) == 8
    spoil(folder)
    refused(lambda: read_scene(folder), *words.split(".*"))
