"""Scenes whose photos are made to disagree: by how much, and which photos change."""

from pathlib import Path

import numpy as np
import pytest

from clsplat.io.photos.views import read_photo
from clsplat.io.scenes.read import read_scene
from clsplat.placement.corrections import correction_between
from clsplat.training.start.prepare import scene_facts
from tools.studies.disagreeing import main, with_other_poses

CITY = Path(__file__).resolve().parents[2] / "data_samples" / "city"


def disagreement(scene):
    return scene_facts(scene, scene.views).disagreement()


@pytest.mark.slow
def test_poses_change_as_asked_and_photos_disagree(tmp_path):
    scene = read_scene(CITY)
    main([str(CITY), str(tmp_path / "out"), "--poses", "0.5"])
    other_scene = read_scene(tmp_path / "out")
    found = [correction_between(before.camera, after.camera)
             for before, after in zip(scene.views, other_scene.views)]
    assert 0.4 < np.sqrt(np.mean([each.degrees**2 for each in found])) < 0.6
    assert all(np.linalg.norm(each.shift) > 0 for each in found)
    again = with_other_poses(scene, 0.5)
    assert all(np.allclose(one.camera.rotation, other.camera.rotation)
               for one, other in zip(again.views, other_scene.views))
    assert disagreement(other_scene) > 1.3 * disagreement(scene)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["noise", "shadows"])
def test_photos_to_train_on_change_as_asked(tmp_path, kind):
    scene = read_scene(CITY)
    main([str(CITY), str(tmp_path / "out"), f"--{kind}", "6", "--test-offset", "3"])
    other_scene = read_scene(tmp_path / "out")
    held_out = {view.name for view in scene.split(8, 3)[1]}
    found = []
    for before, after in zip(scene.views, other_scene.views):
        old, new = read_photo(before).astype(float), read_photo(after).astype(float)
        if before.name in held_out:
            assert np.array_equal(old, new)
            continue
        inner = (old > 40) & (old < 200)  # where nothing is clipped
        found.append(np.std((new - old)[inner] / 255 if kind == "noise" else
                            np.log(new[inner] / old[inner])))
    assert held_out and 0.05 < np.sqrt(np.mean(np.square(found))) < 0.07
    assert disagreement(other_scene) > 1.3 * disagreement(scene)
