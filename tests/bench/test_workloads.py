"""Made models of the benchmarks: what their cameras see."""

import numpy as np
import pytest

from clsplat.bench.workloads import city, in_unit, scene_of, with_hidden
from clsplat.errors import InputError
from clsplat.io.photos.views import read_photo
from clsplat.rendering.pipeline import Renderer

SIZE = (96, 64)


def seen(device, gaussians, cameras, near=0.01):
    """The rows that each camera sees."""
    renderer = Renderer(device, gaussians.sh_degree, near)
    rows = {name: device.upload(values) for name, values in gaussians.rows.items()}
    return [renderer.count_splats(rows, renderer.pack(camera)) for camera in cameras]


def test_no_camera_sees_what_is_hidden(item_device):
    gaussians, cameras = city(300, SIZE)
    among = with_hidden(gaussians, cameras, 1000)
    assert among.count == 1000
    assert seen(item_device, among, cameras) == seen(item_device, gaussians, cameras)
    distances = np.linalg.norm(among.positions, axis=1)
    assert (distances < 1000).sum() == 300
    order = np.lexsort(gaussians.positions.T), np.lexsort(among.positions[distances < 1000].T)
    np.testing.assert_array_equal(gaussians.positions[order[0]],
                                  among.positions[distances < 1000][order[1]])


def test_views_in_all_directions_can_hide_nothing():
    gaussians, (camera, *_) = city(10, SIZE)
    turned = type(camera)(camera.width, camera.height, camera.focal, camera.centre,
                          np.diag([-1.0, 1, -1]) @ camera.rotation, camera.translation)
    with pytest.raises(InputError, match="all directions"):
        with_hidden(gaussians, [camera, turned], 20)


def test_a_made_scene_shows_the_same_in_its_unit(item_device):
    gaussians, cameras = city(300, SIZE)
    scene = scene_of(gaussians, cameras).normalised()
    assert [read_photo(view).shape for view in scene.views] == [(64, 96, 3)] * len(cameras)
    counts = seen(item_device, in_unit(gaussians, scene.unit),
                  [view.camera for view in scene.views], 0.01 / scene.unit)
    np.testing.assert_allclose(counts, seen(item_device, gaussians, cameras), atol=1)
