"""The study of levels of detail: how cameras move away, and whether its numbers are right."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.io.scenes.read import read_scene
from tests.data.tiny_training import CITY
from tools.studies.levels_of_detail import moved_away


@pytest.fixture(scope="module")
def scene():
    return read_scene(CITY)


def test_moved_away_shows_what_it_saw_in_the_part_that_it_names(scene):
    camera = scene.views[3].camera
    for factor in (0.5, 3.0):
        moved, part = moved_away(camera, scene.points, factor)
        pixel, depth = camera.project(scene.points)
        size = camera.width, camera.height
        seen = (depth > 0) & (pixel >= 0).all(axis=1) & (pixel < size).all(axis=1)
        distance = np.median(depth[seen])
        after, further = moved.project(scene.points)
        assert np.allclose(further, depth + factor * distance)
        rows, columns = part
        assert columns.stop - columns.start == pytest.approx(size[0] / (1 + factor), abs=2)
        assert rows.stop - rows.start == pytest.approx(size[1] / (1 + factor), abs=2)
        at_it = seen & (abs(depth - distance) < 0.02 * distance)
        inside = (after[at_it] >= (columns.start - 1, rows.start - 1)).all(axis=1) & (
            after[at_it] < (columns.stop + 1, rows.stop + 1)).all(axis=1)
        assert at_it.sum() > 5 and inside.all()


def test_a_view_that_sees_no_points_cannot_move_away(scene):
    camera = scene.views[0].camera
    turned = replace(camera, rotation=np.diag([1, -1, -1.0]) @ camera.rotation,
                     translation=np.diag([1, -1, -1.0]) @ camera.translation)
    with pytest.raises(InputError, match="^--away: a view sees none of the sparse points, .*; "):
        moved_away(turned, scene.points, 1)
