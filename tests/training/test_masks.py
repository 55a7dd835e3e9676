"""Masked pixels teach nothing: neither gaussians nor exposures, growth or scores know them."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.evaluation.views import evaluate_views
from clsplat.gaussians import Gaussians
from clsplat.io.photos.images import encode_image
from clsplat.io.photos.views import read_photo
from clsplat.io.scenes.read import read_scene
from clsplat.options import TrainOptions
from clsplat.rendering.pipeline import Renderer
from clsplat.schedule.plan import Plan
from clsplat.training.model import Model
from clsplat.training.part import TrainingSample
from clsplat.training.parts.image_term import ImageTerm
from clsplat.training.step import Step
from tests import cases
from tests.data.tiny_training import CITY, LEVELLED, model_digest, records, trained
from tests.kernels.chain import camera_of, size_of

PLAN = Plan(1.0, 1, gathers=True, grows=False, resets_opacity=False, prunes_large=False, decay=0.5)


def masked_city(every, fill):
    """The sample city with a mask for every so many views, filled with noise of a seed."""
    scene = read_scene(CITY)
    rng, views = np.random.default_rng(fill), []
    for number, view in enumerate(scene.views):
        pixels = read_photo(view)
        if number % every == 0:
            valid = np.ones(pixels.shape[:2], bool)
            valid[60:160, 40:200] = False
            pixels[~valid] = rng.integers(0, 256, (np.sum(~valid), 3))
            mask = np.repeat(valid[..., None], 3, 2) * np.uint8(255)
            view = replace(view, mask=encode_image(mask, "png", 0, "mask"))
        views.append(replace(view, source=encode_image(pixels, "png", 0, "photo")))
    return replace(scene, views=tuple(views))


@pytest.mark.slow
def test_what_is_under_masks_changes_no_byte(item_device, tmp_path):
    """Of a training with all parts, and of its scores; half of the views have a mask."""
    runs = [
        trained(tmp_path / str(fill), masked_city(2, fill), item_device, **{**LEVELLED, "iterations": 60})
        for fill in (1, 2)
    ]
    assert model_digest(runs[0]) == model_digest(runs[1])
    scores = [records(run, "eval")[-1] for run in runs]
    assert all(scores[0][key] == scores[1][key] for key in ("psnr", "ssim", "psnr_cc", "ssim_cc"))
    assert records(runs[0], "grow")


def a_step(device, mask):
    """A Step after one step on a photo with this mask, or None, and its rows before."""
    case = cases.gaussians("degree_1")
    width, height = size_of(case)
    photo = np.random.default_rng(0).integers(0, 256, (3, height, width), np.uint8)
    if mask is not None:
        photo = np.concatenate([photo, mask(height, width)[None] * np.uint8(255)])
    renderer = Renderer(device, 1, case["near"])
    rows = {name: values.astype(np.float32) for name, values in case["rows"].items()}
    step = Step(
        renderer, Model(device, Gaussians(rows, 1), "device"), 1.0, 1e-3, TrainOptions(iterations=100), [ImageTerm()]
    )
    step.run(1, PLAN, [TrainingSample(0, renderer.pack(camera_of(case)), device.upload(photo))])
    return step, rows


def test_growth_counts_only_views_that_taught_something(device):
    seen, norms = {}, {}
    for name, mask in (
        ("none", None),
        ("all", lambda *size: np.ones(size, bool)),
        ("empty", lambda *size: np.zeros(size, bool)),
        ("left", lambda height, width: np.arange(width) < np.full((height, 1), width // 4)),
    ):
        step, rows = a_step(device, mask)
        seen[name] = step.statistics.seen_count.download()
        norms[name] = step.statistics.grad_norm_sum.download()
        if name == "empty":
            after = step.model.download().rows
            assert all(np.array_equal(after[field], rows[field]) for field in rows)
    assert not seen["empty"].any() and not norms["empty"].any()
    assert np.array_equal(norms["all"], norms["none"])
    assert np.array_equal(seen["all"], seen["none"])  # a mask without masked pixels is none
    assert 0 < seen["left"].sum() < seen["all"].sum()
    assert seen["left"][norms["left"] > 0].all()


def test_growth_counts_views_that_show_a_gaussian_beside_their_masks(float_device):
    """Also where something hides it, so that it has no gradient: here nothing has one."""
    device, case = float_device, cases.gaussians("degree_1")
    width, height = size_of(case)
    renderer = Renderer(device, 1, case["near"])
    rows = {name: device.upload(values) for name, values in case["rows"].items()}
    frame = renderer.render(rows, renderer.pack(camera_of(case)), width, height, 1)
    photo = np.zeros((4, height, width), np.uint8)
    photo[3, :, width // 2 :] = 255
    seen = device.zeros(len(case["rows"]["positions"]), np.uint32)
    renderer.adjoint(
        rows,
        frame,
        device.zeros((3, height, width)),
        masked=device.upload(photo),
        statistics=(device.zeros(len(seen)), seen),
    )
    across = frame.splats.download()[:, 0].clip(0, width - 1).astype(int)
    assert np.array_equal(seen.download()[frame.visible.download()], across >= width // 2)
    assert 0 < seen.download().sum() < len(across)


def test_a_view_that_is_all_masked_has_no_score(item_device):
    scene = read_scene(CITY).reduced(8)
    empty = replace(scene.views[1], mask=encode_image(np.zeros((240, 320, 3), np.uint8), "png", 0, "mask"))
    gaussians = Gaussians.from_points(scene.points, scene.colours, 0)
    renderer, model = Renderer(item_device, 0, scene.near_plane), Model(item_device, gaussians)
    views = [scene.views[0], empty]
    result = evaluate_views(renderer, model.rows, 0, views)
    assert result["views"] == 1 and [v["name"] for v in result["per_view"]] == [views[0].name]
    assert result["psnr"] == pytest.approx(evaluate_views(renderer, model.rows, 0, views[:1])["psnr"])
    assert np.isnan(evaluate_views(renderer, model.rows, 0, [empty])["psnr"])
