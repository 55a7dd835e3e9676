"""Changes of views without some gaussians: those of the images, by the library's SSIM."""

import numpy as np
import pytest

from clsplat.cities import cut
from clsplat.cities.cut import drop_changes
from clsplat.evaluation.metrics import ssim
from clsplat.evaluation.views import opened, render_view
from clsplat.gaussians import Gaussians
from clsplat.io.scenes.read import read_scene
from clsplat.options import resolve
from tests.data.tiny_training import CITY


@pytest.fixture(scope="module")
def scene():
    return read_scene(CITY).reduced(2)


@pytest.fixture(scope="module")
def gaussians(scene):
    """Opaque ones, so that they are seen."""
    found = Gaussians.from_points(scene.points, scene.colours, 1)
    found.rows["opacity_logits"][:] = 2
    return found


def images(device, gaussians, scene, index, keep):
    """A view's image of all gaussians, and of some."""
    some = Gaussians({name: rows[keep] for name, rows in gaussians.rows.items()}, 1)
    return [
        render_view(*opened(device, model, scene, resolve({}, {})), scene.views[index].camera)
        for model in (gaussians, some)
    ]


@pytest.mark.parametrize("kept", [9, 4])
@pytest.mark.one_in(4)
def test_changes_are_those_of_the_images(float_device, scene, gaussians, monkeypatch, kept):
    """The loss pads the images with zeros; what is kept stays on the device, if there is room."""
    monkeypatch.setattr(cut, "MOST_KEPT", kept)
    x = np.sort(gaussians.positions[:, 0])
    keeps = [gaussians.positions[:, 0] <= x[-last] for last in (1, 10, 30, 300, 1500, 4000)]
    tests = [(index, keep) for index in (9, 17) for keep in keeps]
    found = list(drop_changes(float_device, gaussians, scene, tests))
    exact = [
        1 - ssim(*(np.pad(image, ((5, 5), (5, 5), (0, 0))) for image in images(float_device, gaussians, scene, *test)))
        for test in tests
    ]
    assert found == pytest.approx(exact, rel=0.01, abs=1e-5)
    assert sum(0 < change < 0.1 for change in exact) >= 4 and max(exact) > 0.9


def test_a_view_that_stays_the_same_does_not_change(float_device, scene, gaussians):
    """Though 8 bits do not hold the image exactly."""
    gaussians = Gaussians({**gaussians.rows, "positions": gaussians.positions.copy()}, 1)
    behind = np.arange(gaussians.count) < 9
    camera = scene.views[3].camera
    gaussians.positions[behind] = camera.position - 5 * camera.rotation[2]
    tests = [(3, ~behind), (3, behind | ~behind)]
    assert list(drop_changes(float_device, gaussians, scene, tests)) == [0, 0]
