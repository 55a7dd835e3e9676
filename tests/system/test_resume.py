"""Same seed and device, same bytes: however often a run is stopped, killed or interrupted."""

import shlex
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from clsplat.cli.main import main
from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.io.run import RunFolder
from clsplat.train import loop
from clsplat.train.loop import resume
from clsplat.train.step import Step
from tests.tiny_training import CITY, flags, model_digest, options_of, records, trained

TIMES = ("train_seconds", "wall_seconds", "memory_bytes")


def history(run):
    """The metrics without what the clock and the pool of memory decide."""
    return [{key: value for key, value in record.items() if key not in TIMES}
            for record in run.records()]


@pytest.fixture(scope="module")
def whole(item_device, city, tmp_path_factory):
    """A run that nothing stopped."""
    return trained(tmp_path_factory.mktemp("whole") / "run", city, item_device, eval_every=50)


@pytest.mark.slow
def test_twice_the_same_bytes(float_device, city, tmp_path):
    runs = [trained(tmp_path / name, city, float_device) for name in "ab"]
    assert model_digest(runs[0]) == model_digest(runs[1])
    assert history(runs[0]) == history(runs[1])
    assert sum(record["split"] + record["cloned"] for record in records(runs[0], "grow")) > 1000


def test_another_seed_is_another_run(item_device, city, tmp_path, whole):
    other = trained(tmp_path / "run", city, item_device, seed=1)
    assert model_digest(other) != model_digest(whole)


@pytest.mark.slow
@pytest.mark.parametrize("size", [32, 256])
def test_group_sizes_do_not_matter(item_device, city, tmp_path, whole, size):
    device = Device(item_device.handle, form="item")
    assert device.group_size != size
    device.group_size = size
    assert model_digest(trained(tmp_path / "run", city, device)) == model_digest(whole)


def test_evaluations_and_checkpoints_change_nothing(item_device, city, tmp_path, whole):
    busy = trained(tmp_path / "run", city, item_device, eval_every=7, checkpoint_every=9)
    assert model_digest(busy) == model_digest(whole)


@pytest.mark.parametrize("stops", [(1,), (40, 41, 51), (150,)], ids=str)
def test_stopped_and_resumed(item_device, city, tmp_path, whole, stops):
    """Between rounds of growth, right before and after one and a reset, and at the end."""
    options = {"eval_every": 50}
    run = trained(tmp_path / "run", city, item_device, **options, stop_at=stops[0])
    for stop in (*stops[1:], 0):
        run = RunFolder.open(run.path)
        resume(city, options_of(**options, stop_at=stop), item_device, run)
    assert model_digest(run) == model_digest(whole)
    assert history(run) == history(whole)


def test_crashed_and_resumed(item_device, city, tmp_path, whole, monkeypatch):
    """Steps after the last checkpoint are taken again, and recorded once."""
    take = Step.take

    def crash(step, iteration, *arguments):
        if iteration == 115:
            raise RuntimeError("crashed")
        return take(step, iteration, *arguments)

    with monkeypatch.context() as patch, pytest.raises(RuntimeError, match="crashed"):
        patch.setattr(Step, "take", crash)
        trained(tmp_path / "run", city, item_device, eval_every=50, checkpoint_every=60)
    run = RunFolder.open(tmp_path / "run")
    assert [record["iteration"] for record in run.records()][-3:] == [100, 100, 101]
    resume(city, options_of(eval_every=50, checkpoint_every=60), item_device, run)
    assert model_digest(run) == model_digest(whole)
    assert history(run) == history(whole)


def test_killed_right_after_a_checkpoint(item_device, city, tmp_path, monkeypatch):
    """The step's own record was written before."""
    whole = trained(tmp_path / "whole", city, item_device, stop_at=101)
    save = RunFolder.save_checkpoint

    def save_and_die(run, *arguments):
        save(run, *arguments)
        raise RuntimeError("killed")

    with monkeypatch.context() as patch, pytest.raises(RuntimeError, match="killed"):
        patch.setattr(RunFolder, "save_checkpoint", save_and_die)
        trained(tmp_path / "run", city, item_device, checkpoint_every=100)
    run = RunFolder.open(tmp_path / "run")
    resume(city, options_of(stop_at=101), item_device, run)
    assert history(run) == history(whole)


def test_a_stopped_run_has_its_model(item_device, city, tmp_path):
    run = trained(tmp_path / "run", city, item_device, stop_at=30)
    header = (run.path / "point_cloud.ply").read_bytes()[:300]
    assert b"comment iterations 30\n" in header
    assert run.load_model().count == len(city.points)


@pytest.mark.slow
@pytest.mark.parametrize("options", [{"engine": "numpy"}, {"optimizer": "dense"},
                                     {"antialiased": True, "init": "random"}], ids=str)
def test_other_ways_to_train_resume_as_well(item_device, city, tmp_path, options):
    whole = trained(tmp_path / "whole", city, item_device, **options, iterations=90)
    run = trained(tmp_path / "run", city, item_device, **options, iterations=90, stop_at=53)
    resume(city, options_of(**options, iterations=90), item_device, run)
    assert model_digest(run) == model_digest(whole)


def test_a_resumed_run_needs_no_initial_file(item_device, city, tmp_path, whole):
    start = tmp_path / "start.ply"
    shutil.copy(whole.path / "point_cloud.ply", start)
    run = trained(tmp_path / "run", city, item_device, init=str(start), stop_at=5)
    start.unlink()
    resume(city, options_of(init=str(start), stop_at=6), item_device, run)


def test_time_goes_on(item_device, city, tmp_path):
    run = trained(tmp_path / "run", city, item_device, stop_at=110)
    before = records(run, "step")[-1]
    resume(city, options_of(), item_device, run)
    after = records(run, "eval")[-1]
    for key in ("train_seconds", "wall_seconds"):
        assert after[key] > before[key] > 0


# --- the checkpoint is checked


def test_another_scene_is_refused(item_device, city, tmp_path):
    run = trained(tmp_path / "run", city, item_device, stop_at=2)
    other = replace(city, points=city.points + 1e-6)
    with pytest.raises(InputError, match="run: this run was trained on another scene, .*city; "):
        resume(other, options_of(), item_device, run)
    foreign = trained(tmp_path / "foreign", other, item_device, stop_at=2)
    (run.path / "checkpoint.npz").write_bytes((foreign.path / "checkpoint.npz").read_bytes())
    with pytest.raises(InputError, match="run: its checkpoint is of another scene; put back"):
        resume(city, options_of(), item_device, run)


def test_a_checkpoint_that_lacks_something_is_refused(item_device, city, tmp_path):
    run = trained(tmp_path / "run", city, item_device, stop_at=2)
    arrays, state = run.load_checkpoint()
    for name in ("row.positions", "m.quaternions", "v.sh_rest", "statistics.seen_count"):
        run.save_checkpoint({key: array for key, array in arrays.items() if key != name}, state)
        with pytest.raises(InputError, match=f"run: its checkpoint lacks '{name}'; start again"):
            resume(city, options_of(), item_device, run)


def test_a_broken_training_keeps_its_checkpoint(item_device, city, tmp_path, monkeypatch):
    """A loss that is not finite ends the run and is not saved over the last good state."""
    run = trained(tmp_path / "run", city, item_device, stop_at=20)
    kept = (run.path / "checkpoint.npz").read_bytes()
    monkeypatch.setattr(loop, "loss_value", lambda *arguments: (np.nan, np.nan, np.nan))
    with pytest.raises(InputError, match="run: the loss at step 50 is nan; the last checkpoint"):
        resume(city, options_of(checkpoint_every=50), item_device, run)
    assert (run.path / "checkpoint.npz").read_bytes() == kept


# --- stopped from outside

SLOW = {"iterations": 400, "densify_until": 120}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The run that the commands below start, through the command line and on its device."""
    folder = tmp_path_factory.mktemp("undisturbed") / "run"
    invoked("train", CITY, "-o", folder, "-q", *flags(**SLOW, checkpoint_every=10))
    return RunFolder.open(folder)


def invoked(*words):
    result = CliRunner().invoke(main, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    return result


def started(folder, wait_for):
    """A training in a process of its own that has written a file of its run."""
    process = subprocess.Popen(
        [sys.executable, "-m", "clsplat", "train", str(CITY), "-o", str(folder), "-q",
         *flags(**SLOW, checkpoint_every=10)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 120
    while not (folder / wait_for).exists():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.005)
    return process


@pytest.mark.slow
@pytest.mark.parametrize("wait_seconds", [0.0, 0.3, 0.7])
def test_killed_and_resumed(tmp_path, undisturbed, wait_seconds):
    folder = tmp_path / "run"
    process = started(folder, "checkpoint.npz")
    time.sleep(wait_seconds)
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    assert not (folder / "point_cloud.ply").exists()
    invoked("train", CITY, "-o", folder, "-q", "--resume")
    run = RunFolder.open(folder)
    assert model_digest(run) == model_digest(undisturbed)
    assert history(run) == history(undisturbed)
    assert not list(folder.glob("*.partial*"))


@pytest.mark.slow
def test_interrupted_and_resumed_as_it_says(tmp_path, undisturbed):
    folder = tmp_path / "run"
    process = started(folder, "metrics.jsonl")
    time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130, said
    assert said.count("\n") == 1 and said.startswith("stopped after step ")
    command = shlex.split(said.partition("go on with: ")[2])
    assert command[:2] == ["clsplat", "train"] and "--resume" in command
    assert not (folder / "point_cloud.ply").exists()
    invoked(*command[1:], "-q")
    assert model_digest(RunFolder.open(folder)) == model_digest(undisturbed)
    assert history(RunFolder.open(folder)) == history(undisturbed)
