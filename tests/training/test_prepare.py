"""Which space a training keeps free of gaussians, and that growth does so."""

from unittest.mock import patch

import numpy as np
import pytest

from clsplat.densify.free_space import FreeSpace
from clsplat.io.scenes.read import read_scene
from clsplat.options import resolve
from clsplat.training.prepare import prepare
from tests.data.tiny_training import CITY, LEVELLED, records, trained


@pytest.mark.parametrize("share, held", [(0.0, None), (0.2, [False, False]), (0.5, [True, False]),
                                         (0.9, [True, True])])
def test_free_space_is_what_a_photo_shows_nearer_than_a_share_of_its_nearest_points(share, held):
    prepared = prepare(read_scene(CITY), resolve({}, {"iterations": 50, "free_space": share}))
    scene, space = prepared.scene, prepared.free_space
    if held is None:
        assert space is None
        return
    camera = prepared.train_views[0].camera
    seen = scene.points[prepared.train_views[0].sees(scene.points)]
    nearest = np.quantile(camera.project(seen)[1], 0.01)
    before = camera.position + np.outer([0.4, 0.7], nearest * camera.rotation[2])
    assert space.holds(before).tolist() == held


@pytest.mark.slow
def test_growth_of_a_training_removes_what_stands_there(tmp_path, float_device):
    scene = read_scene(CITY)
    with patch.object(FreeSpace, "holds", lambda _, positions: np.arange(len(positions)) >= 100):
        run = trained(tmp_path / "run", scene, float_device, **LEVELLED, free_space=0.5)
    assert records(run, "grow")[0]["pruned"] >= len(scene.points) - 100
