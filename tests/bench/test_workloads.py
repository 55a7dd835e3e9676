"""Made models of the benchmarks: what their cameras see."""

import numpy as np

from clsplat.bench.workloads import city, in_unit, scene_of
from clsplat.io.photos.views import read_photo
from clsplat.rendering.pipeline import Renderer

SIZE = (96, 64)


def seen(device, gaussians, cameras, near=0.01):
    """The rows that each camera sees."""
    renderer = Renderer(device, gaussians.sh_degree, near)
    rows = {name: device.upload(values) for name, values in gaussians.rows.items()}
    return [renderer.count_splats(rows, renderer.pack(camera)) for camera in cameras]


def test_a_made_scene_shows_the_same_in_its_unit(item_device):
    gaussians, cameras = city(300, SIZE)
    scene = scene_of(gaussians, cameras).normalised()
    assert [read_photo(view).shape for view in scene.views] == [(64, 96, 3)] * len(cameras)
    counts = seen(item_device, in_unit(gaussians, scene.unit),
                  [view.camera for view in scene.views], 0.01 / scene.unit)
    np.testing.assert_allclose(counts, seen(item_device, gaussians, cameras), atol=1)
