"""The division of a scene's views into those to train on and those that are held out, and which way
is up."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.io.scenes.colmap_files import write_colmap
from clsplat.io.scenes.read import read_scene
from clsplat.scene import View, rows_by_view
from tests.io.photos.test_metadata import photo


def held_out(scene, *division):
    return [view.name for view in scene.split(*division)[1]]


def test_offsets_hold_out_other_views(city):
    names = [view.name for view in city.views]
    divisions = [held_out(city, 8, offset) for offset in range(8)]
    assert divisions[0] == held_out(city, 8) == names[::8] and divisions[3] == names[3::8]
    assert sorted(sum(divisions, [])) == sorted(names)
    train, test = city.split(8, 3)
    assert sorted(view.name for view in (*train, *test)) == sorted(names)
    assert not {view.name for view in train} & {view.name for view in test}


def test_no_offset_changes_what_the_data_set_defines(city):
    defined = dataclasses.replace(city, held_out=frozenset({city.views[1].name}))
    assert held_out(defined, 8, 5) == held_out(defined, 8) == [city.views[1].name]
    assert held_out(city, 0, 5) == []


@pytest.mark.parametrize("stored_upright", [True, False])
def test_portraits_stand_upright_however_they_are_stored(tmp_path, stored_upright):
    """Photos of a telephone around an object, which COLMAP takes as they are stored."""
    places = np.random.default_rng(0).normal(size=(50, 3))
    quarters = 0 if stored_upright else 3
    (tmp_path / "images").mkdir()
    views = []
    for angle in np.linspace(0, np.pi, 12):
        position = 6 * np.cos(angle), 6 * np.sin(angle), 1.0
        camera = Camera.looking_at((0, 0, 0), position, width=48, height=64).turned(quarters)
        views.append(View(f"{len(views):02d}.jpg", camera, Path("none")))
        photo(
            tmp_path / "images" / views[-1].name,
            {"Orientation": 1 if stored_upright else 6},
            size=(camera.width, camera.height),
        )
    write_colmap(tmp_path / "sparse/0", views, places, np.zeros((50, 3), np.uint8))
    scene = read_scene(tmp_path)
    assert scene.up @ (0, 0, 1) > 0.99
    assert scene.first_view.rotation[1] @ scene.up < -0.9  # its downward axis


def test_rows_of_views_are_in_order_however_many_views_there_are():
    for views in (5, 65_539):
        view = np.random.default_rng(0).permutation(np.repeat([1, 4, views - 1], 20))
        found = rows_by_view(view, views)
        assert len(found) == views and sum(map(len, found)) == 60
        for number in (0, 1, views - 1):
            assert np.array_equal(found[number], np.flatnonzero(view == number))
