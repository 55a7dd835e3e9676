"""Depth maps on the device, and trainings that they hold."""

import shutil

import numpy as np
import pytest

from clsplat.gaussians import Gaussians
from clsplat.io.photos.depth import with_depths
from clsplat.io.photos.images import encode_image
from clsplat.io.scenes.read import read_scene
from clsplat.options import TrainOptions
from clsplat.rendering.pipeline import Renderer
from clsplat.schedule.plan import Plan
from clsplat.training.model import Model
from clsplat.training.part import TrainingSample
from clsplat.training.parts import depth_maps
from clsplat.training.parts.depth_maps import DepthMaps, depth_array
from clsplat.training.parts.image_term import ImageTerm
from clsplat.training.photos import decode
from clsplat.training.step import Step
from tests.data.tiny_training import CITY, STILL, records, trained

PLAN = Plan(1.0, 0, gathers=True, grows=False, resets_opacity=False, prunes_large=False, decay=0.5)
DEPTH = 30.0  # of all pixels; the city is 20 to 55 away


@pytest.fixture
def folder(tmp_path):
    """The sample city with a depth map for every other photo."""
    shutil.copytree(CITY, tmp_path / "city")
    (tmp_path / "city/depth").mkdir()
    for view in read_scene(tmp_path / "city").views[::2]:
        np.save(tmp_path / f"city/depth/{view.name}.npy", np.full((24, 32), DEPTH))
    return tmp_path / "city"


@pytest.mark.parametrize("share", [1.0, 0.0])
def test_maps_are_in_units_of_the_scene(item_device, folder, monkeypatch, share):
    """Whether they stay on the device or are read at each use."""
    monkeypatch.setattr(depth_maps, "DEVICE_SHARE", share)
    scene = with_depths(read_scene(folder), "depth").reduced(8).normalised()
    valid = np.ones((240, 320, 3), np.uint8) * 255
    valid[:80] = 0
    views = list(scene.views)
    views[2] = type(views[2])(**{**vars(views[2]), "mask": encode_image(valid, "png", 0, "mask")})
    maps = DepthMaps()
    maps.use(item_device, views, scene.unit)
    assert maps.resident == (share > 0)
    assert maps.map_of(1) is None and depth_array(views[1]) is None
    assert maps.map_of(0).shape == depth_array(views[0]).shape == (30, 40)
    assert np.allclose(maps.map_of(0).download(), DEPTH / scene.unit)
    masked = maps.map_of(2).download()
    assert not masked[:10].any() and np.allclose(masked[10:], DEPTH / scene.unit)


@pytest.mark.slow
def test_a_step_uses_the_map_of_a_view_that_has_one(device):
    """From a recording, too: a view without a map is another kind of step."""
    scene = read_scene(CITY).reduced(8).normalised()
    renderer = Renderer(device, 0, scene.near_plane)
    camera, known = scene.views[0].camera, device.upload(np.full((30, 40), 0.3))
    photo, packed = device.upload(decode(scene.views[0])), renderer.pack(camera)

    def moved(depth_weight, *depths):
        maps, values = DepthMaps(depth_weight), []
        step = Step(
            renderer,
            Model(device, Gaussians.from_points(scene.points, scene.colours, 0), "device"),
            scene.extent,
            1e-3,
            TrainOptions(iterations=100),
            [ImageTerm(), *[maps] * (depth_weight > 0)],
        )
        for number, depth in enumerate(depths, 1):
            maps.map_of = lambda view, depth=depth: depth
            values.append(step.values(step.run(number, PLAN, [TrainingSample(0, packed, photo)])))
        return step.model.download().rows["positions"], values

    plain, _ = moved(0.0, known, known, None)
    held, values = moved(5.0, known, known, None)
    other, _ = moved(5.0, known, known, known)
    assert not np.array_equal(held, plain) and not np.array_equal(held, other)
    assert all(value["depth_error"] > 0.1 for value in values[:2])
    assert "depth_error" not in values[2]
    unheld, _ = moved(5.0, None, None, None)
    assert np.array_equal(unheld, plain)


@pytest.mark.slow
def test_a_training_is_held_by_its_maps(item_device, folder):
    """The more, the more they weigh; these maps contradict the photos."""
    errors = {}
    for weight in (0.01, 3.0):
        run = trained(
            folder.parent / f"run_{weight}",
            read_scene(folder),
            item_device,
            **STILL,
            iterations=200,
            depth="depth",
            depth_weight=weight,
        )
        found = [record["depth_error"] for record in records(run, "step") if "depth_error" in record]
        errors[weight] = found[-1]
    assert errors[3.0] < 0.95 * errors[0.01], errors
