"""Scenes whose poses are disturbed: by how much, and that their photos disagree."""

from pathlib import Path

import numpy as np

from clsplat.io.scenes import read_scene
from clsplat.placement.corrections import correction_between
from clsplat.training.facts import scene_facts
from tools.studies.disturbed_poses import disturbed, main

CITY = Path(__file__).resolve().parents[2] / "data_samples" / "city"


def test_poses_are_disturbed_as_asked_and_photos_disagree(tmp_path):
    scene = read_scene(CITY)
    main([str(CITY), "0.5", str(tmp_path / "out.npz")])
    packed = read_scene(tmp_path / "out.npz")
    found = [correction_between(before.camera, after.camera)
             for before, after in zip(scene.views, packed.views)]
    assert 0.4 < np.sqrt(np.mean([each.degrees**2 for each in found])) < 0.6
    assert all(np.linalg.norm(each.shift) > 0 for each in found)
    again = disturbed(scene, 0.5)
    assert all(np.allclose(one.camera.rotation, other.camera.rotation)
               for one, other in zip(again.views, packed.views))
    assert (scene_facts(packed, packed.views).disagreement()
            > 1.3 * scene_facts(scene, scene.views).disagreement())
