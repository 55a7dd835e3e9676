"""Same seed and device, same bytes: however often a run is stopped, killed or interrupted."""

import shlex
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.io.runs.run import RunFolder, read_poses
from clsplat.schedule import sig
from clsplat.training.parts import image_term
from clsplat.training.step import Step
from tests.command_line import clsplat_
from tests.data import tiny_training
from tests.data.tiny_training import LEVELLED, model_digest, options_of, records, resume, resumed, trained
from tests.signals import listen, needs_signals

TIMES = ("train_seconds", "wall_seconds", "memory_bytes", "peak_bytes")


def history(run):
    """The metrics without what the clock and the pool of memory decide."""
    return [
        {key: value for key, value in record.items() if key not in TIMES}
        for record in run.records()
        if record["event"] != "time"
    ]


@pytest.mark.slow
def test_evaluations_and_checkpoints_change_nothing(item_device, city, tmp_path, eventful):
    busy = trained(tmp_path / "run", city, item_device, eval_every=37, checkpoint_every=43)
    assert model_digest(busy) == model_digest(eventful)


@pytest.mark.slow
@pytest.mark.parametrize("stops", [(1, 40, 41, 51), (150,)], ids=str)
def test_stopped_and_resumed(item_device, city, tmp_path, eventful, stops):
    """Between rounds of growth, right before and after one and a reset, and at the end."""
    options = {"eval_every": 50}
    run = trained(tmp_path / "run", city, item_device, **options, stop_at=stops[0])
    for stop in (*stops[1:], 0):
        resumed(run, city, item_device, **options, stop_at=stop)
    assert model_digest(run) == model_digest(eventful)
    assert history(run) == history(eventful)


@pytest.mark.slow
def test_crashed_and_resumed(item_device, city, tmp_path, eventful, monkeypatch):
    """Steps after the last checkpoint are taken again, and recorded once."""
    take = Step.run

    def crash(step, iteration, *arguments):
        if iteration == 115:
            raise RuntimeError("crashed")
        return take(step, iteration, *arguments)

    with monkeypatch.context() as patch, pytest.raises(RuntimeError, match="crashed"):
        patch.setattr(Step, "run", crash)
        trained(tmp_path / "run", city, item_device, eval_every=50, checkpoint_every=60)
    run = RunFolder.open(tmp_path / "run")
    assert [(record["event"], record["iteration"]) for record in run.records()][-4:] == [
        ("eval", 100),
        ("step", 100),
        ("grow", 101),
        ("reset", 101),
    ]
    resume(city, options_of(eval_every=50, checkpoint_every=60), item_device, run)
    assert model_digest(run) == model_digest(eventful)
    assert history(run) == history(eventful)


@pytest.mark.slow
@pytest.mark.parametrize(
    "options", [{"poses": "on"}, {"engine": "numpy"}, {"antialiased": True, "init": "random"}], ids=str
)
@pytest.mark.one_in(3)
def test_other_ways_to_train_resume_as_well(item_device, city, tmp_path, options):
    whole = trained(tmp_path / "whole", city, item_device, **options, iterations=90)
    run = trained(tmp_path / "run", city, item_device, **options, iterations=90, stop_at=53)
    resume(city, options_of(**options, iterations=90), item_device, run)
    assert model_digest(run) == model_digest(whole)
    if "poses" in options:
        corrected, expected = read_poses(run.path), read_poses(whole.path)
        assert len(corrected) == 28 and all(  # and they have moved since the warm-up
            0 < np.abs(each.turn).max()
            and np.array_equal(each.turn, expected[name].turn)
            and np.array_equal(each.shift, expected[name].shift)
            for name, each in corrected.items()
        )


@pytest.mark.slow
def test_levels_stopped_and_resumed(item_device, city, tmp_path, levelled):
    """Growth follows a step; a level is decided after one step and begins with the next."""
    level = records(levelled, "level")[0]["iteration"]
    grown = [record["iteration"] for record in records(levelled, "grow")]
    stops = (grown[0], level, level + 1)
    run = trained(tmp_path / "run", city, item_device, **LEVELLED, stop_at=stops[0])
    for stop in (*stops[1:], 0):
        resumed(run, city, item_device, **LEVELLED, stop_at=stop)
    assert model_digest(run) == model_digest(levelled)
    assert history(run) == history(levelled)


@pytest.mark.slow
def test_a_run_keeps_the_levels_that_an_earlier_version_chose(item_device, city, tmp_path, monkeypatch, levelled):
    stop, chosen = records(levelled, "level")[0]["iteration"] + 1, {**LEVELLED, "levels": ()}
    with monkeypatch.context() as earlier:
        earlier.setattr(sig, "levels_of", lambda *_: LEVELLED["levels"])
        run = trained(tmp_path / "run", city, item_device, **chosen, stop_at=stop)
    resumed(run, city, item_device, **chosen)
    assert model_digest(run) == model_digest(levelled)


EVENTFUL = {"iterations": 60, "densify_until": 50, "densify_from": 5, "densify_every": 7}
# 28 training views are no multiple of 3: epochs end within a step, exposures are recentred there,
# and what is drawn goes by the view, not by the step
SCHEDULES = {
    "mcmc": {**EVENTFUL, "mcmc_growth": 0.2, "max_gaussians": 9000},
    "dash": {**EVENTFUL, "downscale": 4.0},
    "taming": {**EVENTFUL, "taming_budget": 1.5},
    "sig": {**LEVELLED, "batch": 3, "iterations": 40, "vignetting": "on"},
}


@pytest.mark.slow
@pytest.mark.parametrize("schedule", SCHEDULES)
@pytest.mark.one_in(4)
def test_schedules_stopped_and_resumed(item_device, city, tmp_path, schedule):
    options = {"schedule": schedule, **SCHEDULES[schedule]}
    whole = trained(tmp_path / "whole", city, item_device, **options)
    assert schedule == "sig" or len(records(whole, "grow")) > 3
    assert schedule != "dash" or len({record["level"] for record in whole.records()}) > 1
    run = trained(tmp_path / "run", city, item_device, **options, stop_at=13)
    for stop in (36, 0):
        resumed(run, city, item_device, **options, stop_at=stop)
    assert model_digest(run) == model_digest(whole)
    assert history(run) == history(whole)


def test_another_scene_is_refused(item_device, city, tmp_path):
    run = trained(tmp_path / "run", city, item_device, stop_at=2)
    other = replace(city, points=city.points + 1e-6)
    with pytest.raises(InputError, match="run: this run was trained on another scene, .*city; "):
        resume(other, options_of(), item_device, run)
    foreign = trained(tmp_path / "foreign", other, item_device, stop_at=2)
    (run.path / "checkpoint.npz").write_bytes((foreign.path / "checkpoint.npz").read_bytes())
    with pytest.raises(InputError, match="run: its checkpoint is of another scene; put back"):
        resume(city, options_of(), item_device, run)


def test_a_broken_training_keeps_its_checkpoint(item_device, city, tmp_path, monkeypatch):
    """A loss that is not finite ends the run and is not saved over the last good state."""
    run = trained(tmp_path / "run", city, item_device, stop_at=20)
    kept = (run.path / "checkpoint.npz").read_bytes()
    monkeypatch.setattr(image_term, "loss_value", lambda *_: 3 * (np.nan,))
    with pytest.raises(InputError, match="run: the loss at step 50 is nan; the last checkpoint"):
        resume(city, options_of(checkpoint_every=50), item_device, run)
    assert (run.path / "checkpoint.npz").read_bytes() == kept


@pytest.mark.slow
def test_a_model_that_cannot_be_written_is_written_later(item_device, city, tmp_path, monkeypatch, eventful):
    """A thread writes it during the last evaluation; its error ends the run."""

    def full(*_):
        raise InputError("the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr(RunFolder, "save_model", full)
        with pytest.raises(InputError, match="the disk is full"):
            trained(tmp_path / "run", city, item_device, eval_every=50)
    run = resumed(RunFolder(tmp_path / "run"), city, item_device, eval_every=50)
    assert model_digest(run) == model_digest(eventful) and history(run) == history(eventful)


SLOW = {**LEVELLED, "iterations": 200, "reset_every": 80, "checkpoint_every": 10}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """What the commands below start, through the command line, on its device."""
    folder = tmp_path_factory.mktemp("undisturbed") / "run"
    invoked("train", tiny_training.CITY, "-o", folder, "-q", *tiny_training.flags(**SLOW))
    return RunFolder.open(folder)


def invoked(*words):
    result = clsplat_(*words)
    assert result.exit_code == 0, result.output
    return result


def started(run, is_there, *words):
    """A command in a process of its own that trains, once something of its run is there."""
    process = subprocess.Popen(
        [sys.executable, "-m", "clsplat", *map(str, words), "-q"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=listen,
    )
    deadline = time.monotonic() + 300
    while not is_there(run):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.005)
    return process


@needs_signals
@pytest.mark.slow
def test_interrupted_resumed_as_it_says_killed_and_resumed(tmp_path, undisturbed):
    run, whole = RunFolder(tmp_path / "run"), undisturbed
    process = started(
        run,
        lambda run: (run.path / "metrics.jsonl").exists(),
        "train",
        tiny_training.CITY,
        "-o",
        run.path,
        *tiny_training.flags(**SLOW),
    )
    time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=300)
    assert process.returncode == 130, said
    assert said.count("\n") == 1 and said.startswith("stopped after step ")
    command = shlex.split(said.partition("go on with: ")[2])
    assert command[:2] == ["clsplat", "train"] and "--resume" in command

    saved = run.checkpoint_iteration()
    process = started(run, lambda run: run.checkpoint_iteration() > saved, *command[1:])
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    assert not run.has_model
    invoked(*command[1:], "-q")
    assert model_digest(run) == model_digest(whole)
    assert history(run) == history(whole)
    assert not list(run.path.glob("*.partial*"))
