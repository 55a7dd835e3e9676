"""Faults that the campaign found, one test each."""

import os

import pytest
from click.testing import CliRunner

from clsplat.cli.main import main
from clsplat.errors import InputError
from clsplat.io.run import RunFolder
from clsplat.options import from_toml


@pytest.mark.parametrize("words", [
    ("render", "city", "-o", "out", "--lod", "--lod-bias", "nan"),
    ("render", "city", "-o", "out", "--lod", "--away", "inf"),
    ("render", "city", "-o", "out", "--lod", "--downscale", "nan"),
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
