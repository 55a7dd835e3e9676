"""Which space a training keeps free of gaussians."""

import numpy as np
import pytest

from clsplat.io.scenes import read_scene
from clsplat.options import resolve
from clsplat.training.prepare import prepare
from tests.data.tiny_training import CITY


@pytest.mark.parametrize("options, held", [
    ({"coarse": True}, [True, False]), ({}, None), ({"free_space": 0.9}, [True, True]),
    ({"free_space": 0.2}, [False, False]), ({"coarse": True, "free_space": 0.0}, None),
    ({"coarse": True, "schedule": "constant"}, None), ({"coarse": True, "preset": "paper"}, None),
    ({"coarse": True, "preset": "release"}, None)], ids=str)
def test_parts_of_a_city_keep_free_what_is_close_before_cameras(options, held):
    prepared = prepare(read_scene(CITY), resolve({}, {"iterations": 50, **options}))
    scene, space = prepared.scene, prepared.free_space
    if held is None:
        assert space is None
        return
    camera = prepared.train_views[0].camera
    seen = scene.points[prepared.train_views[0].sees(scene.points)]
    nearest = np.quantile(camera.project(seen)[1], 0.01)
    before = camera.position + np.outer([0.4, 0.7], nearest * camera.rotation[2])
    assert space.holds(before).tolist() == held
