"""`kill -9` at any moment: the resumed run's model has the bytes of one that nothing disturbed."""

import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from clsplat.cli.train import resumed_options
from clsplat.io.runs.run import RunFolder
from tests.data.tiny_training import CITY, LEVELLED, ROOT, flags, model_digest, records, resume, trained
from tests.system.test_resume import history

pytestmark = pytest.mark.nightly  # tests/system/test_resume.py kills a run once
# everything that a run has: two levels, growth at both, exposures, adjacent photos, evaluations
WHOLE = {**LEVELLED, "iterations": 90, "checkpoint_every": 10, "eval_every": 25}
SHORT = {"iterations": 30, "densify_from": 10, "checkpoint_every": 9, "test_every": 16}


def moments(seed=4):
    """Eight: one at any time, seven inside of what must be whole or not at all."""
    rng = np.random.default_rng(seed)
    anywhere = [("step", f"{rng.integers(1, 70)}.{rng.integers(0, 300):03d}")]
    # kind -> from which on, and how often it comes in a run
    inside = {
        "checkpoint": (1, 250),
        "growth": (1, 4),
        "rename": (2, 11),
        "renamed": (1, 11),
        "record": (1, 10),
        "evaluation": (1, 4),
        "model": (1, 1),
    }
    return anywhere + [(kind, str(first + rng.integers(count))) for kind, (first, count) in inside.items()]


def begun(device, options):
    """The command line's words for the options, on the device."""
    wanted = os.environ.get("CLSPLAT_TEST_DEVICES", "all")
    return ["--device", "auto" if wanted == "all" else wanted, *flags(form=device.form, **options)]


def killed(folder, moment, number, *words):
    """`clsplat train` in a process of its own, until it dies."""
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "tests.adversarial.kill",
            moment,
            number,
            "train",
            str(CITY),
            "-o",
            str(folder),
            "-q",
            *words,
        ],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == -signal.SIGKILL, done.stderr
    return RunFolder(folder)


def resumed(run, city, device):
    run = RunFolder.open(run.path)
    resume(city, resumed_options(run.read_options(), {}), device, run)
    return run


@pytest.fixture(scope="module")
def whole(item_device, city, tmp_path_factory):
    return trained(tmp_path_factory.mktemp("whole") / "run", city, item_device, **WHOLE)


def test_the_run_is_eventful(whole):
    """Or the moments below would not come."""
    assert len(moments()) == 8
    assert len(records(whole, "grow")) == 4 and len(records(whole, "level")) == 1
    assert len(whole.records()) >= 10 and len(records(whole, "eval")) == 4


@pytest.mark.parametrize("moment, number", moments())
def test_killed_and_resumed(whole, item_device, city, tmp_path, moment, number):
    run = killed(tmp_path / "run", moment, number, *begun(item_device, WHOLE))
    assert moment not in ("checkpoint", "rename") or list(run.path.glob("*.part"))
    run = resumed(run, city, item_device)
    assert model_digest(run) == model_digest(whole)
    assert history(run) == history(whole)
    assert not list(run.path.glob("*.part"))


def test_killed_again_and_again(item_device, city, tmp_path):
    """One run. At `rename 1` it has not begun: the same command begins it; `renamed 1` and
    `step 5` come before its first checkpoint."""
    whole = trained(tmp_path / "whole", city, item_device, **SHORT)
    assert len(records(whole, "grow")) == 1
    words = begun(item_device, SHORT)
    for moment, number in (
        ("rename", "1"),
        ("renamed", "1"),
        ("step", "5"),
        ("growth", "1"),
        ("saved", "1"),
        ("model", "1"),
    ):
        run = killed(tmp_path / "run", moment, number, *words)
        assert not run.has_model
        words = ["--resume"] if (run.path / "options.json").exists() else words
    run = resumed(run, city, item_device)
    assert model_digest(run) == model_digest(whole)
    assert history(run) == history(whole)
