"""Schedules of other packages, by entry points."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.data.tiny_training import CITY

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def clsplat(tmp_path):
    """A function that runs the command line where packages register schedules."""
    shutil.copy(ROOT / "docs" / "examples" / "halves.py", tmp_path)
    (tmp_path / "wrong.py").write_text("number = 3\nraise_ = 1\n")
    (tmp_path / "broken.py").write_text("raise RuntimeError('no such thing')\n")
    info = tmp_path / "others-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: others\nVersion: 1\n")
    (info / "entry_points.txt").write_text(
        "[clsplat.schedules]\nhalves = halves:Halves\nwrong = wrong:number\nbroken = broken:X\n")

    def run(*words):
        path = os.pathsep.join((str(ROOT), str(tmp_path)))
        return subprocess.run([sys.executable, "-m", "clsplat", *map(str, words)], text=True,
                              capture_output=True, env={**os.environ, "PYTHONPATH": path},
                              cwd=tmp_path, check=False)
    return run


@pytest.mark.slow
def test_a_schedule_in_one_file(clsplat, tmp_path):
    done = clsplat("train", CITY, "--schedule", "halves", "-n", "40", "-r", "8", "--densify-every",
                   "5", "-o", "run")
    assert done.returncode == 0, done.stderr
    options = json.loads((tmp_path / "run" / "options.json").read_text())
    assert (options["schedule"], options["opacity_rate"]) == ("halves", 0.05)
    records = [json.loads(line) for line in (tmp_path / "run/metrics.jsonl").open()]
    assert [r["iteration"] for r in records if r["event"] == "grow"] == [15, 20, 25]
    assert {r["level"] for r in records if r["iteration"] <= 20 and r["event"] != "plan"} == {2.0}
    assert records[-1]["level"] == 1.0
    assert clsplat("eval", "run", "--no-images").returncode == 0
    assert options["half_share"] == 0.5
    whole = " ".join(clsplat("train", "--help-all").stdout.split())
    assert "--half-share FLOAT Share of the run at half size" in whole
    done = clsplat("train", CITY, "--schedule", "halves", "-n", "8", "-r", "8", "--half-share",
                   "0.25", "-o", "other", "--snapshots")
    assert done.returncode == 0, done.stderr
    records = [json.loads(line) for line in (tmp_path / "other/metrics.jsonl").open()]
    assert {r["level"] for r in records if r["event"] == "eval"} == {1.0, 2.0}
    done = clsplat("train", CITY, "--half-share", "0.25", "-o", "third")
    assert done.returncode == 2 and done.stderr == (
        "error: --half-share: has no effect with --schedule sig; leave it out, or use --schedule "
        "halves\n")
    (tmp_path / "others-1.dist-info" / "entry_points.txt").write_text("")
    gone = clsplat("eval", "run", "--no-images")
    assert gone.returncode == 2 and "one of sig, constant, dash, taming, mcmc" in gone.stderr


@pytest.mark.parametrize("name, words", [
    ("wrong", "not a subclass of clsplat.Schedule"), ("broken", "RuntimeError: no such thing"),
    ("nothing", "expects one of sig, constant, dash, taming, mcmc, broken, halves, wrong")])
@pytest.mark.one_in(3)
def test_what_is_no_schedule_is_one_line(clsplat, name, words):
    done = clsplat("train", CITY, "--schedule", name, "-n", "4", "-r", "8", "-o", "run")
    assert done.returncode == 2 and words in done.stderr, done.stderr
    assert done.stderr.count("error: ") == 1 and "Traceback" not in done.stderr
