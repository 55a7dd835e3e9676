"""Faults that the campaign found, one test each."""

import json
import os

import numpy as np
import pytest
from click.testing import CliRunner

from clsplat.cli.main import main, verdict
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.io.models.ply import write_ply
from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.read import fingerprint, read_scene
from clsplat.options import from_toml, resolve
from clsplat.training import checkpoint
from clsplat.training.loop import resume
from tests.data.tiny_training import CITY


@pytest.mark.parametrize("words", [
    ("render", "city", "-o", "out", "--lod", "--lod-bias", "nan"),
    ("pack", "city", "-o", "a.npz", "-r", "nan"), ("export", "run", "-o", "a.ply", "--sh-cost",
                                                   "nan"),
    ("block", "city", "--wait", "nan"), ("compare", "run", "--psnr", "inf")], ids=" ".join)
def test_numbers_that_are_none_are_refused(words):
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 2 and ("finite" in result.stderr or "range" in result.stderr)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no named pipes")
def test_options_from_a_pipe_that_nobody_writes_to(tmp_path):
    os.mkfifo(tmp_path / "run.toml")
    with pytest.raises(InputError, match="it is not a file"):
        from_toml(tmp_path / "run.toml")


def test_a_run_whose_metrics_were_removed_has_no_past(tmp_path):
    run = RunFolder.create(tmp_path)
    run.write_options({})
    assert run.past_records() == []


def test_a_model_of_nothing_is_not_rendered(tmp_path):
    nothing = Gaussians.from_points(np.eye(3), np.zeros((3, 3), np.uint8), 0)
    nothing = Gaussians({name: rows[:0] for name, rows in nothing.rows.items()}, 0)
    write_ply(tmp_path / "nothing.ply", nothing)
    result = CliRunner().invoke(main, ["render", str(tmp_path / "nothing.ply"), "--scene",
                                       str(CITY), "-o", str(tmp_path / "out")])
    assert result.exit_code == 2 and "nothing.ply: holds no gaussians" in result.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("decisions", [[], "x", 3, {"sh_degree": "x"}, {"sh_degree": 9}], ids=str)
def test_decisions_of_another_kind_are_refused(tmp_path, decisions):
    run = RunFolder.create(tmp_path / "run")
    scene = read_scene(CITY)
    run.write_options({"scene": CITY, "fingerprint": fingerprint(scene)})
    record = json.loads((run.path / "options.json").read_text()) | {"decisions": decisions}
    (run.path / "options.json").write_text(json.dumps(record))
    state = {key: {} if dict in np.atleast_1d(kinds) else 1
             for key, (kinds, _) in checkpoint.STATE.items()}
    run.save_checkpoint({}, state | {"fingerprint": record["fingerprint"]})
    with pytest.raises(InputError, match="options.json"):
        resume(scene, resolve({}, {}), None, run)


def test_options_of_a_windows_editor_are_read(tmp_path):
    (tmp_path / "run.toml").write_text("seed = 3\n", encoding="utf-8-sig")
    assert from_toml(tmp_path / "run.toml") == {"seed": 3}


def test_a_library_that_finds_no_memory_is_no_bug():
    error = ImportError("libOpenImageIO.so: failed to map segment from shared object")
    assert verdict(error)[1] == 2 and "memory" in verdict(error)[0]
    assert verdict(ImportError("no module named x"))[1] == 1
