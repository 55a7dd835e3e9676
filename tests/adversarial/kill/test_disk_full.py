"""A full disk ends a training with one line; what was saved before is whole, and goes on."""

import errno
import os
import resource
import shutil
import signal

import pytest

from clsplat.cli.main import verdict
from clsplat.errors import InputError
from clsplat.io import atomic
from clsplat.io.runs.run import RunFolder
from clsplat.training.loop import resume
from tests.data.tiny_training import STILL, model_digest, options_of, trained

pytestmark = pytest.mark.slow  # tests/io/runs/test_run.py has the fast one

OPTIONS = {**STILL, "iterations": 24, "test_every": 16}
STOP, EVERY = 12, 8  # steps: of the half run, between checkpoints


@pytest.fixture(scope="module")
def runs(item_device, city, tmp_path_factory):
    """(one that nothing stopped, one stopped half way)."""
    folder = tmp_path_factory.mktemp("runs")
    return (trained(folder / "whole", city, item_device, **OPTIONS),
            trained(folder / "half", city, item_device, **OPTIONS, stop_at=STOP))


@pytest.fixture
def half(runs, tmp_path):
    shutil.copytree(runs[1].path, tmp_path / "run")
    return RunFolder.open(tmp_path / "run")


@pytest.fixture
def full(monkeypatch):
    """full(run, name): what is next written for this file of the run meets a full disk."""
    synced, left = os.fsync, []

    def fsync(number):
        path = os.readlink(f"/proc/self/fd/{number}")
        if path in left:
            left.remove(path)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        synced(number)
    monkeypatch.setattr(atomic.os, "fsync", fsync)
    return lambda run, name: left.append(str(run.path.resolve() / f"{name}.part"))


def refused(run, city, device, name, every=EVERY):
    """Going on ends with a line about this file; returns the step of the checkpoint then."""
    with pytest.raises(InputError) as caught:
        # an evaluation on the way writes to the metrics before the last checkpoint does
        evaluated = () if every else (STOP + 2,)
        resume(city, options_of(**OPTIONS, checkpoint_every=every, eval_at=evaluated), device, run)
    message, code = verdict(caught.value)
    assert code == 2 and "\n" not in message
    assert message.startswith(f"error: {run.path / name}: cannot be written (")
    assert "; free some space" in message and "--resume" in message
    assert not (run.path / f"{name}.part").exists()
    return run.load_checkpoint()[1]["iteration"]


@pytest.mark.parametrize("name, kept", [
    ("checkpoint.npz", STOP), ("report.html", 24), ("point_cloud.ply", 24)])
def test_full_disk(runs, half, full, item_device, city, name, kept):
    """The checkpoint before, or the last, stays; with room again the run ends as if nothing had
    happened."""
    before = (half.path / "checkpoint.npz").read_bytes()
    full(half, name)
    assert refused(half, city, item_device, name) == kept
    assert kept > STOP or (half.path / "checkpoint.npz").read_bytes() == before
    assert half.has_model is (name == "report.html")  # which comes last
    resume(city, options_of(**OPTIONS), item_device, RunFolder.open(half.path))
    assert model_digest(half) == model_digest(runs[0])


@pytest.fixture
def no_longer_file():
    """no_longer_file(size): no file grows past so many bytes until the test ends."""
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, limit[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    signal.signal(signal.SIGXFSZ, handler)


@pytest.mark.parametrize("name, share, every", [
    ("checkpoint.npz", 0.5, EVERY), ("metrics.jsonl", 1.1, 0)])
def test_disk_fills_up(runs, half, item_device, city, no_longer_file, name, share, every):
    """While a checkpoint is half written, or in the middle of a line."""
    before = (half.path / "checkpoint.npz").read_bytes()
    no_longer_file(int(share * (half.path / name).stat().st_size))
    refused(half, city, item_device, name, every)
    assert (half.path / "checkpoint.npz").read_bytes() == before
    no_longer_file(resource.RLIM_INFINITY)
    resume(city, options_of(**OPTIONS), item_device, RunFolder.open(half.path))
    assert model_digest(half) == model_digest(runs[0])
