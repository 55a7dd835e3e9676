"""The study of how true maps are, on a scene whose photos are drawn from the map itself."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

import clsplat
from clsplat.apps.map_grid import map_grid
from clsplat.evaluation.metrics import psnr
from clsplat.io.photos.images import encode_image
from clsplat.options import TrainOptions
from tests.data import ground_model as made
from tools.studies import orthophoto


def photographed(device):
    """The made-up scene with photos of its model, whose ground has a texture."""
    model, scene = made.model(), made.scene(None, width=160)
    noise = np.random.default_rng(0).normal(0, 0.5, (model.count, 1))
    model.rows["sh_constant"][:] += noise.astype(np.float32)
    views = []
    for view in scene.views:
        camera = dataclasses.replace(view.camera, offset=made.OFFSET)
        image = clsplat.render(model, camera, device=device)
        photo = encode_image(np.clip(image, 0, 1), "png", 100, "photo")
        views.append(dataclasses.replace(view, source=photo))
    scene = dataclasses.replace(scene, views=tuple(views))
    return SimpleNamespace(finished_model=model, options=TrainOptions()), scene


@pytest.mark.slow
def test_a_true_map_is_found_true_and_a_shifted_one_is_not(item_device):
    run, scene = photographed(item_device)
    grid = map_grid(scene, 0.1)
    colours, heights = orthophoto.painted(run, scene, grid, item_device)
    flat = orthophoto.flat_ground(heights, grid)
    ground = abs(heights - 7) < 0.1
    assert 0.3 < flat.mean() < 1 and (ground | ~flat | (abs(heights - 9) < 0.1)).all()
    mean, number = orthophoto.mean_photo(scene, grid, orthophoto.smooth(heights))
    chosen = flat & (number >= 3) & ground
    image, target = colours[..., :3] / 255, mean
    true = psnr(image[chosen][None], target[chosen][None])
    moved = psnr(np.roll(image, 3, axis=1)[chosen][None], target[chosen][None])
    assert true > 28 and moved < true - 4
    assert np.quantile(abs(orthophoto.at_points(scene, grid, heights)), 0.5) < 0.3
    away, error = orthophoto.distances(scene, grid, colours, heights)
    assert len(away) > 50 and np.linalg.norm(np.median(away, axis=0)) < 0.5
    assert np.median(error) < 0.01
    shifted, _ = orthophoto.distances(scene, grid, np.roll(colours, 4, axis=1), heights)
    assert np.allclose(np.median(shifted, axis=0), (4, 0), atol=0.5)
