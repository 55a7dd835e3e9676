"""The object of a run: its options, scene and renderer in one place, and what it refuses."""

import dataclasses
import shutil

import numpy as np
import pytest

from clsplat.api.run import Run
from clsplat.api.score import Score
from clsplat.cli.evaluate import summary
from clsplat.errors import InputError
from clsplat.evaluation import run as run_module
from clsplat.evaluation.metrics import psnr
from clsplat.evaluation.run import to_render
from clsplat.evaluation.views import evaluate_run, photo_of, render_view
from clsplat.gaussians import Gaussians
from clsplat.io.runs.run import RunFolder, write_exposures, write_poses
from clsplat.io.scenes.read import fingerprint, read_scene
from clsplat.options import resolve
from clsplat.placement.corrections import Correction
from clsplat.report.run import lead
from clsplat.response import Response
from tests.data.tiny_training import CITY
from tests.refusals import refused

OPTIONS = {"downscale": 8.0, "background": (0.3, 0.2, 0.1), "near": 2.0, "test_every": 16}


@pytest.fixture(scope="module")
def scene():
    return read_scene(CITY)


@pytest.fixture
def run(tmp_path, scene):
    """A finished run of gaussians on the sparse points."""
    folder = RunFolder.create(tmp_path / "run")
    folder.write_options({"scene": CITY, "fingerprint": fingerprint(scene), **dataclasses.asdict(resolve({}, OPTIONS))})
    folder.save_model(Gaussians.from_points(scene.points, scene.colours, 1), scene.offset)
    return Run.open(folder.path)


def test_the_scene_is_as_it_was_trained_on(run, scene):
    assert run.options == resolve({}, OPTIONS) and run.record["fingerprint"] == fingerprint(scene)
    assert run.metrics == [] and run.exposures is None and not run.is_finished
    camera, whole = run.scene().views[0].camera, scene.views[0].camera
    assert (camera.width, camera.height) == (whole.width // 8, whole.height // 8)
    assert run.scene(whole=True).views[0].camera.width == whole.width


def test_without_held_out_views_the_word_none_is_named(run, scene):
    run.folder.write_options(
        {
            "scene": CITY,
            "fingerprint": fingerprint(scene),
            **dataclasses.asdict(resolve({}, {**OPTIONS, "test_every": 0})),
        }
    )
    with pytest.raises(InputError, match=r"no held-out views \(--test-every none\); nothing"):
        evaluate_run(Run.open(run.path), None, save_images=False)


@pytest.mark.slow
def test_held_out_views_have_an_exposure_that_training_photos_tell(run, item_device):
    """And their lens's vignetting; a report and `eval` state it."""
    scene = run.scene()
    train, test = scene.split(OPTIONS["test_every"])
    plain = run.evaluate(item_device)
    assert plain.exposure_weight is None
    lens = np.array([-0.5, 0, 0, 1.0])
    dim = Response(np.column_stack([0.5 * np.eye(3), [0.1, 0, 0]]), lens)
    write_exposures(run.path, {view.name: dim for view in train})
    result = evaluate_run(run, item_device, save_images=False)
    assert result["exposure_weight"] == 0  # all are equal, which no neighbour tells better
    model = run.opened(item_device, scene)
    expected = []
    for view in test:
        shown = 0.5 * render_view(*model, view.camera) * dim.gain(view.camera)[:, :, None]
        expected.append(psnr(np.clip(shown + [0.1, 0, 0], 0, 1), photo_of(view)))
    assert result["psnr"] == pytest.approx(np.mean(expected), abs=1e-3)
    assert abs(result["psnr"] - plain.psnr) > 0.1
    assert "exposure of held-out views: 0% interpolated" in summary(result)
    assert Score.of(result).exposure_weight == 0
    told = lead({}, [{"event": "eval", **result}])
    assert "Exposure of held-out views: 0% interpolated" in told


def test_training_views_have_the_poses_that_the_run_corrected(run, scene):
    """Where they are shown; a resumed training begins with the given ones and its checkpoint."""
    train, test = run.scene().split(OPTIONS["test_every"])
    moved = Correction(np.array([0.0, 0.01, 0.0]), np.array([0.0, 0.0, 0.5]))
    write_poses(run.path, {view.name: moved for view in train})
    given = {view.name: view.camera for view in train + test}
    for shown in (run.scene(), to_render(run.path, None)[1]):
        for view in shown.views:
            expected = given[view.name]
            if view.name in {view.name for view in train}:
                expected = moved.applied(expected)
                away = np.linalg.norm(expected.position - given[view.name].position)
                assert away == pytest.approx(0.5)
            assert np.array_equal(view.camera.rotation, expected.rotation)
            assert np.allclose(view.camera.position, expected.position, atol=1e-9)
    for view in run.scene(whole=True).views:
        assert np.array_equal(view.camera.rotation, given[view.name].rotation)
    for text in ('{"a": [1, 2]}', '{"a": [1, 2, 3, 4, 5, 1e300]}', "[]", "{"):
        (run.path / "poses.json").write_text(text)
        refused(run.scene, "poses.json: not a file of corrected poses, dama")


@pytest.mark.slow
def test_scores_from_aligned_poses_stand_beside_the_others(run, item_device):
    plain = run.evaluate(item_device)
    result = evaluate_run(run, item_device, save_images=False, align=True)
    score = Score.of(result)
    assert (score.psnr, score.ssim_cc, score.flip) == (plain.psnr, plain.ssim_cc, plain.flip)
    assert plain.psnr_aligned is None and plain.aligned_degrees is None
    assert score.psnr_aligned != score.psnr and 0 < score.aligned_degrees < 2
    assert 0 < score.aligned_shift < 0.05
    lines = summary(result).splitlines()
    assert [line.split()[0] for line in lines[2:6]] == ["plain", "colour-corrected", "aligned", "both"]
    assert f"{score.psnr_cc_aligned:.2f}" in lines[5] and "degrees" in lines[6]
    small = evaluate_run(run, item_device, False, run.scene().reduced(2))
    assert "aligned" not in summary(small) and small["psnr"] != plain.psnr


def test_another_scene_is_refused(run, tmp_path):
    shutil.copytree(CITY, tmp_path / "other")
    points = tmp_path / "other/sparse/0/points3D.bin"
    data = bytearray(points.read_bytes())
    data[16:24] = np.float64(7.5).tobytes()  # x of the first point
    points.write_bytes(data)
    refused(lambda: run.scene(tmp_path / "other"), "other: is not the scene that", "was trained on")


def test_a_run_is_rendered_by_the_cameras_of_any_scene(run, scene, tmp_path, monkeypatch):
    """Its gaussians stay where they are, though the other scene has another local origin."""
    away = np.array([40.0, -7.0, 3.0])
    other = dataclasses.replace(scene, points=scene.points - away, offset=scene.offset + away)
    monkeypatch.setattr(run_module, "read_scene", lambda *_: other)
    gaussians, shown, _ = to_render(run.path, tmp_path / "other")
    assert np.array_equal(gaussians.offset, shown.offset)
    model = run.finished_model
    assert np.allclose(gaussians.positions + gaussians.offset, model.positions + model.offset, atol=1e-4)


def test_a_renderer_draws_as_the_run_was_trained(run, scene, item_device):
    small = run.scene()
    renderer, rows, degree = run.opened(item_device, small)
    assert degree == 1 and renderer.near == 2.0
    empty = run.finished_model.scaled(1e-6)  # too small to cover anything but the background
    empty.rows["opacity_logits"][:] = -30
    image = render_view(*run.opened(item_device, small, empty), small.views[0].camera)
    assert np.allclose(image, OPTIONS["background"], atol=1e-3)
