"""Models larger than the device, in slabs of depth: the image of a render in one piece."""

import dataclasses

import numpy as np
import pytest

from clsplat.evaluation.run import Run
from clsplat.evaluation.views import evaluate_run
from clsplat.gaussians import Gaussians
from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.read import read_scene
from clsplat.rendering import slabs
from clsplat.rendering.slabs import Parts, SlabRenderer, open_model
from tests import cases
from tests.data.tiny_training import CITY, options_of
from tests.kernels import chain

# of a pixel that ended: the light left is below TRANSMITTANCE_MIN / (1 - ALPHA_MAX)
STOP = 1e-2


def in_slabs(device, case, limit, rows=None, part=16, with_depth=True, depth_percent=0, **options):
    """(image, depth, transmittance, number of slabs)."""
    renderer = SlabRenderer(
        device, chain.stored_degree(case), case["near"], background=case["background"], limit=limit, **options
    )
    parts = Parts.of(case["rows"] if rows is None else rows, part)
    frame = renderer.render(
        parts, renderer.pack(chain.camera_of(case)), *chain.size_of(case), case["degree"], with_depth, depth_percent
    )
    return *downloaded(frame), frame.slabs


def downloaded(frame):
    blended = frame.blended
    return tuple(array.download() for array in (frame.image, blended.depth, blended.transmittance))


def faint(name, **changes):
    """A case in which no pixel becomes opaque: nothing stops, so only rounding may differ."""
    case = cases.gaussians(name, **changes)
    case["rows"]["opacity_logits"] = np.minimum(case["rows"]["opacity_logits"], -3)
    case["rows"]["sh_constant"] = case["rows"]["sh_constant"].clip(-1, 1)
    return case


def same_to_rounding(actual, expected):
    for got, target in zip(actual, expected):
        assert abs(got - target).max() <= 2e-6 * (1 + abs(target).max())


@pytest.mark.parametrize("name", ["ragged", "giants", "near_plane"])
def test_any_number_of_slabs_gives_the_same_picture(device, name):
    case = faint(name)
    _, _, whole = chain.render(device, case, with_depth=True)
    assert whole.blended.transmittance.download().min() > 1e-3
    drawn = len(whole.visible)
    for limit in (drawn, -(-drawn // 2), -(-drawn // 7), 1):
        *actual, slabs_drawn = in_slabs(device, case, limit)
        assert slabs_drawn == -(-drawn // limit)
        same_to_rounding(actual, downloaded(whole))


@pytest.mark.parametrize("limit", [3, 10, 16])
def test_ties_of_depth_are_drawn_in_the_order_of_rows(float_device, limit):
    case = faint("plain", count=60)
    rows = case["rows"]
    rows["positions"][:, 2] = np.resize([4.0, 3.0], 60)
    rows["opacity_logits"][:] = -1
    rows["positions"][:, :2] *= 0.1
    _, _, whole = chain.render(float_device, case, with_depth=True)
    *actual, _ = in_slabs(float_device, case, limit, part=7)
    assert abs(actual[0] - whole.image.download()).max() < STOP
    backwards = {name: values[::-1] for name, values in rows.items()}
    *other, _ = in_slabs(float_device, case, limit, backwards, part=7)
    assert abs(other[0] - whole.image.download()).max() > 0.05


@pytest.mark.parametrize("name", ["stack", "many", "opacities"])
def test_what_the_stop_leaves_out_is_within_its_bound(device, name):
    case = cases.gaussians(name)
    case["rows"]["sh_constant"] = case["rows"]["sh_constant"].clip(-1, 1)
    _, _, whole = chain.render(device, case, with_depth=True)
    for limit in (len(whole.visible) // 2, len(whole.visible) // 7 + 1):
        image, _, left, _ = in_slabs(device, case, limit)
        error = abs(image - whole.image.download())
        assert error.max() <= STOP * max(1, image.max())
        assert (left <= whole.blended.transmittance.download() + 1e-6).all()
        if name == "many":
            assert error.mean() <= 1e-5


@pytest.mark.parametrize("name", sorted(set(cases.SCENES) - {"empty"}))
def test_what_is_drawn_is_in_a_part_that_is_seen(item_device, name):
    """Each gaussian has its own box, so the bound is tried where it is tightest."""
    for seed in range(4):
        case = cases.gaussians(name, seed=seed, count=min(300, 4 * cases.SCENES[name][0]))
        rows = case["rows"]
        rows["positions"] = rows["positions"] * np.float32(1.7)  # many just outside
        renderer = chain.renderer_of(item_device, case)
        camera = chain.camera_of(case)
        frame = renderer.render(chain.upload_rows(item_device, rows), renderer.pack(camera), *chain.size_of(case), 0)
        seen = {piece.start for piece in Parts.of(rows, 1).seen(camera, case["near"])}
        assert set(frame.visible.download()) <= seen


def test_a_model_that_fits_is_rendered_in_one_piece(float_device, monkeypatch):
    case = cases.gaussians("degree_1")
    rows = {name: values.astype(np.float32) for name, values in case["rows"].items()}
    gaussians = Gaussians(rows, 1)
    renderer, _ = open_model(float_device, gaussians, case["near"])
    assert not isinstance(renderer, SlabRenderer)
    monkeypatch.setattr(slabs, "gaussian_limit", lambda *_: len(rows["positions"]) - 1)
    renderer, parts = open_model(float_device, gaussians, case["near"])
    assert isinstance(renderer, SlabRenderer) and isinstance(parts, Parts)


@pytest.mark.slow
def test_a_model_that_does_not_fit_is_evaluated_all_the_same(float_device, tmp_path, monkeypatch):
    city = read_scene(CITY)
    run = RunFolder.create(tmp_path)
    options = dataclasses.asdict(options_of(background=(0.3, 0.2, 0.1)))
    run.write_options({"scene": CITY, **options})
    gaussians = Gaussians.from_points(city.points, city.colours, 1)
    gaussians.rows["opacity_logits"][:] = 1
    run.save_model(gaussians, city.offset)
    whole = evaluate_run(Run(run), float_device, save_images=False)
    limits = []
    monkeypatch.setattr(slabs, "gaussian_limit", lambda *_: (limits.append(1), gaussians.count // 6)[1])
    slabbed = evaluate_run(Run(run), float_device, save_images=False)
    assert limits
    for score in ("psnr", "ssim", "psnr_cc", "ssim_cc"):
        assert abs(slabbed[score] - whole[score]) < 1e-3, score
