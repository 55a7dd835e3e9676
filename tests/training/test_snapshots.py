"""Snapshots of levels, which 3D Tiles show at a distance: kept through kills."""


import numpy as np
import pytest

from clsplat.gaussians import Gaussians
from clsplat.io.models.ply import read_ply
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
