"""Held-out views are moved to where the model looks most like their photos."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.evaluation.align import aligned
from clsplat.evaluation.views import evaluate_views, render_view
from clsplat.gaussians import Gaussians
from clsplat.io.photos.images import write_image
from clsplat.io.photos.views import read_photo
from clsplat.placement.corrections import Correction
from clsplat.rendering.slabs import open_model
from clsplat.scene import View

DEPTH = 4.0


@pytest.fixture
def seen(item_device, tmp_path):
    """((renderer, rows, degree), view): a view whose photo is the render, darker and redder."""
    rng = np.random.default_rng(0)
    points = rng.uniform((-3, -2, -0.5), (3, 2, 0.5), (400, 3))
    model = Gaussians.from_points(points, rng.integers(0, 256, (400, 3)).astype(np.uint8), 1)
    model.rows["opacity_logits"][:] = 2
    camera = Camera.looking_at((0, 0, 0), (0.3, -1, DEPTH), width=96, height=64)
    renderer, rows = open_model(item_device, model, 0.1)
    image = render_view(renderer, rows, 1, camera) * (0.9, 0.7, 0.7) + 0.05
    write_image(tmp_path / "a.png", np.rint(255 * image).astype(np.uint8))
    return (renderer, rows, 1), View("a.png", camera, tmp_path / "a.png")


def pixels_off(camera, true):
    """Mean distance of points in both images."""
    points = np.random.default_rng(1).uniform((-1.5, -1, -0.5), (1.5, 1, 0.5), (50, 3))
    return np.linalg.norm(camera.project(points)[0] - true.project(points)[0], axis=1).mean()


@pytest.mark.slow
def test_a_wrong_pose_is_found_again_under_other_colours(seen):
    model, view = seen
    true = view.camera
    wrong = Correction(np.array([0.008, -0.01, 0.01]), np.array([0.03, 0.02, -0.04])).applied(true)
    before = {name: array.download() for name, array in model[1].items()}
    correction = aligned(*model, replace(view, camera=wrong), DEPTH)
    found = correction.applied(wrong)
    assert pixels_off(wrong, true) > 1 and pixels_off(found, true) < 0.1
    for name, array in model[1].items():
        assert np.array_equal(array.download(), before[name])
    result = evaluate_views(*model, [replace(view, camera=wrong)], align=DEPTH)
    assert result["psnr_cc_aligned"] > result["psnr_cc"] + 5
    assert result["aligned_degrees"] == correction.degrees  # the same bytes again
    assert 0.3 < correction.degrees < 2 and 0 < result["aligned_shift"] < 0.05


@pytest.mark.slow
def test_a_right_pose_stays(seen):
    model, view = seen
    found = aligned(*model, view, DEPTH).applied(view.camera)
    assert pixels_off(found, view.camera) < 0.05


@pytest.mark.slow
def test_masked_pixels_do_not_count(seen, tmp_path):
    model, view = seen
    mask = np.full((64, 96), 255, np.uint8)
    mask[:, 60:] = 0
    write_image(tmp_path / "mask.png", np.repeat(mask[:, :, None], 3, 2))
    results = []
    for value in (0, 255):
        photo = np.array(read_photo(view))
        photo[:, 60:] = value
        write_image(tmp_path / "b.png", photo)
        masked = replace(view, source=tmp_path / "b.png", mask=tmp_path / "mask.png")
        results.append(aligned(*model, masked, DEPTH))
    assert np.array_equal(results[0].turn, results[1].turn)
    assert pixels_off(results[0].applied(view.camera), view.camera) < 0.1


def test_a_model_that_does_not_fit_the_device_cannot_be_aligned(seen):
    with pytest.raises(InputError, match="cannot be aligned: the model is larger than the mem"):
        aligned(object(), None, 0, seen[1], DEPTH)
