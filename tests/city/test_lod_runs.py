"""Snapshots of levels, and a run drawn from them: kept through kills, compared as told."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from clsplat.cities import lod
from clsplat.cities.lod import Levels
from clsplat.cli.main import main
from clsplat.evaluation.run import Run, to_render
from clsplat.evaluation.views import opened, photo_of, render_view
from clsplat.gaussians import Gaussians
from clsplat.io.models.ply import read_ply
from clsplat.io.photos.images import read_image
from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.read import read_scene
from clsplat.training.step import Step
from tests.data.tiny_training import CITY, LEVELLED, model_digest, records, resumed, trained
from tests.reference.frequency import scene_frequency

OPTIONS = {**LEVELLED, "reproject": "off", "exposure": "off", "iterations": 60, "downscale": 6.0,
           "snapshots": True}

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def scene():
    return read_scene(CITY)


@pytest.fixture(scope="module")
def run(item_device, scene, tmp_path_factory):
    """A run with a snapshot of its level 2; not to be changed."""
    return trained(tmp_path_factory.mktemp("lod") / "run", scene, item_device, **OPTIONS)


def test_a_snapshot_is_the_model_as_its_level_ended(item_device, scene, tmp_path, run):
    (factor, path), = run.snapshots()
    level, = records(run, "level")
    assert factor == 2.0 and path == run.path / "lod" / "level_2.ply"
    header = path.read_bytes().partition(b"end_header")[0].decode()
    stopped = trained(tmp_path / "run", scene, item_device, **OPTIONS, stop_at=level["iteration"])
    assert not stopped.snapshots()  # the level's last step is taken, the next has not begun
    arrays, _ = stopped.load_checkpoint()
    saved = read_ply(path)
    assert np.array_equal(saved.quaternions, arrays["row.quaternions"])
    values = scene_frequency(saved.log_scales.astype(float), saved.opacity_logits.astype(float))
    for name in ("paper", "release", "robust"):
        told = float(header.partition(f"comment frequency {name} ")[2].split()[0])
        assert told == pytest.approx(values[f"{name}_mean"], rel=1e-3)
    assert "comment level 2\n" in header
    assert f"comment iterations {level['iteration']}\n" in header
    resumed(stopped, scene, item_device, **OPTIONS)
    assert stopped.snapshots()[0][1].read_bytes() == path.read_bytes()
    assert model_digest(stopped) == model_digest(run)


def test_killed_after_the_snapshot_and_resumed(item_device, scene, tmp_path, run, monkeypatch):
    """The level is left again, with the same bytes."""
    level, = records(run, "level")
    take = Step.run

    def crash(step, iteration, *arguments):
        if iteration == level["iteration"] + 1:
            raise RuntimeError("killed")
        return take(step, iteration, *arguments)

    with monkeypatch.context() as patch, pytest.raises(RuntimeError, match="killed"):
        patch.setattr(Step, "run", crash)
        trained(tmp_path / "run", scene, item_device, **OPTIONS, checkpoint_every=25)
    half = RunFolder.open(tmp_path / "run")
    (_, path), = half.snapshots()
    path.write_bytes(b"older")
    resumed(half, scene, item_device, **OPTIONS, checkpoint_every=25)
    assert path.read_bytes() == run.snapshots()[0][1].read_bytes()
    assert model_digest(half) == model_digest(run)


def test_snapshots_change_nothing_else(item_device, scene, tmp_path, run):
    without = trained(tmp_path / "run", scene, item_device, **{**OPTIONS, "snapshots": False})
    assert not (without.path / "lod").exists()
    assert model_digest(without) == model_digest(run)
    assert [r["kernel_bytes"] for r in without.records()] == [
        r["kernel_bytes"] for r in run.records()]


def test_the_folder_knows_its_snapshots(tmp_path):
    run, model = RunFolder.create(tmp_path / "run"), Gaussians.from_points(
        np.eye(3), np.zeros((3, 3), np.uint8), 0)
    assert run.snapshots() == []
    for factor in (2.0, 5 / 3, 10.0):
        run.save_snapshot(factor, model, np.zeros(3), ("level 5",))
    for name in ("level_mine.ply", "level_3.ply.part", "notes.txt"):
        (run.path / "lod" / name).write_text("mine")
    assert [factor for factor, _ in run.snapshots()] == [10.0, 2.0, 1.66667]
    run.write_options({})
    RunFolder.create(run.path, overwrite=True).write_options({})
    assert sorted(p.name for p in (run.path / "lod").iterdir()) == ["level_mine.ply", "notes.txt"]


def rendered(path, out, device, *words):
    """(what `clsplat render --lod` prints, the picture of its first view)."""
    result = CliRunner().invoke(main, ["render", str(path), "--lod", "-o", str(out), "--device",
                                       device.name, *words])
    assert result.exit_code == 0, result.output
    return result.output, read_image(min(out.rglob("*.png")))


def test_near_levels_are_the_full_model_and_far_ones_less(item_device, run, tmp_path):
    said, near = rendered(run.path, tmp_path / "near", item_device, "--lod-bias", "1e-6",
                          "--views", "test", "--beside")
    gaussians, scene, options = to_render(run.path, None)
    view = scene.split(options.test_every)[1][0]
    full = render_view(*opened(item_device, gaussians, scene, options), view.camera)
    assert f"100.0% of {gaussians.count:,} gaussians drawn" in said
    assert abs(near / 255 - np.concatenate([full, photo_of(view)], axis=1)).max() < 0.003
    said, far = rendered(run.path, tmp_path / "far", item_device, "--lod-bias", "1e6",
                         "--views", "test")
    share = read_ply(run.snapshots()[0][1]).count / gaussians.count
    assert f"{share:.1%} of" in said and share < 1
    assert abs(far / 255 - full).mean() > 0.003


def test_a_choice_that_stays_is_not_taken_again(item_device, scene, run, monkeypatch):
    detail = lod.Detail(Run(run), scene.reduced(4), item_device)
    taken, take = [], Levels.select
    monkeypatch.setattr(Levels, "select", lambda *a: taken.append(1) or take(*a))
    near = scene.views[0].camera.reduced(4)
    distance = np.linalg.norm(near.position)  # between this and 31 times as far levels change
    detail.pixels = near.focal[0] / (5 * distance * detail.levels.frequencies[0])
    far = replace(near, translation=near.translation + [0, 0, 30 * distance])
    counts = []
    for camera in (near, near, far, near):
        detail.draw(camera)
        counts.append(detail.chosen.count)
    assert len(taken) == 3 and counts[0] == counts[1] == counts[3] > counts[2]


def test_a_run_without_levels_says_how_to_get_them(run, tmp_path):
    bare, early = (shutil.copytree(run.path, tmp_path / name) for name in ("bare", "early"))
    shutil.rmtree(bare / "lod")
    (early / "point_cloud.ply").unlink()
    for model, said in ((bare, "bare: has no levels of detail; train it to its end with snap"),
                        (early, "early/point_cloud.ply: the run has no model yet"),
                        (bare / "point_cloud.ply", "point_cloud.ply: holds no run")):
        result = CliRunner().invoke(main, ["render", str(model), "--lod", "-o", str(tmp_path)])
        assert result.exit_code == 2 and said in result.output
