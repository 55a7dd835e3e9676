"""Schedules and parts of other packages, by entry points."""

import json
import os
import subprocess
import sys

import pytest

from tests.data.tiny_training import CITY, ROOT

RECORD = "open('imported', 'a').write(__name__)\n"  # what a module does that records its import
BASE = "from clsplat import Plan, Schedule\nclass S(Schedule):\n"
TINY = (
    "train",
    CITY,
    "-n",
    "4",
    "-r",
    "8",
    "-o",
    "run",
    "-q",
    "--test-every",
    "none",
    "--exposure",
    "off",
    "--init",
    "sfm",
)


@pytest.fixture
def package(tmp_path):
    """A function that makes a package `others` of a module's text, which registers entries of a
    group; the result runs the command line beside it."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(ROOT), str(tmp_path)))}

    def install(text, entries, group="clsplat.schedules"):
        (tmp_path / "module.py").write_text(text)
        info = tmp_path / "others-1.dist-info"
        info.mkdir(exist_ok=True)
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: others\nVersion: 1\n")
        (info / "entry_points.txt").write_text(f"[{group}]\n{entries}\n")

        def run(*words):
            return subprocess.run(
                [sys.executable, "-m", "clsplat", *map(str, words)],
                text=True,
                env=environment,
                cwd=tmp_path,
                capture_output=True,
                check=False,
            )

        return run

    return install


@pytest.mark.slow
def test_a_schedule_in_one_file(package, tmp_path):
    clsplat = package((ROOT / "docs/examples/halves.py").read_text(), "halves = module:Halves")
    (tmp_path / "every.toml").write_text("densify-every = 5\n")
    done = clsplat("train", CITY, "--schedule", "halves", "-n", "40", "-r", "8", "--config", "every.toml", "-o", "run")
    assert done.returncode == 0, done.stderr
    options = json.loads((tmp_path / "run" / "options.json").read_text())
    assert (options["schedule"], options["opacity_rate"]) == ("halves", 0.05)
    records = [json.loads(line) for line in (tmp_path / "run/metrics.jsonl").open()]
    assert [r["iteration"] for r in records if r["event"] == "grow"] == [15, 20, 25]
    assert {r["level"] for r in records if r["iteration"] <= 20 and r["event"] != "plan"} == {2.0}
    assert records[-1]["level"] == 1.0
    assert clsplat("eval", "run", "--no-images").returncode == 0
    assert options["half_share"] == 0.5
    whole = " ".join(clsplat("train", "--schedule", "halves", "--help-all").stdout.split())
    assert "--half-share FLOAT Share of the run at half size" in whole
    (tmp_path / "run.toml").write_text('schedule = "halves"\nhalf-share = 0.75\nsh-degree = 1\n')
    done = clsplat(
        "train",
        CITY,
        "--config",
        "run.toml",
        "-n",
        "8",
        "-r",
        "8",
        "--half-share",
        "0.25",
        "--eval-every",
        "1",
        "-o",
        "other",
    )
    assert done.returncode == 0, done.stderr
    records = [json.loads(line) for line in (tmp_path / "other/metrics.jsonl").open()]
    assert {r["level"] for r in records if r["event"] == "eval"} == {1.0, 2.0}
    options = json.loads((tmp_path / "other/options.json").read_text())
    assert options["half_share"] == 0.25
    done = clsplat("train", CITY, "--half-share", "0.25", "-o", "fourth")
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert "--half-share" in done.stderr
    (tmp_path / "others-1.dist-info" / "entry_points.txt").write_text("")
    gone = clsplat("eval", "run", "--no-images")
    assert gone.returncode == 2 and "one of sig, constant, dash, taming, mcmc" in gone.stderr


@pytest.mark.parametrize(
    "words, code",
    [
        (("--help",), 0),
        (("train", "--help"), 0),
        (("devices",), 0),
        (("--version",), 0),
        pytest.param(TINY, 0, marks=pytest.mark.slow),
        (("train", "nothing", "--schedule", "sig", "-o", "run"), 2),
        (("plan", "nothing", "--schedule", "unknown"), 2),
        (("train", "nothing", "--levels", "2,1", "--schedule", "mcmc", "-o", "run"), 2),
    ],
)
@pytest.mark.one_in(7)
def test_no_command_imports_a_schedule_that_it_does_not_name(package, tmp_path, words, code):
    clsplat = package(RECORD + "import sys\nsys.exit(0)\n", "x = module:S\nsig = module:S")
    done = clsplat(*words)
    assert done.returncode == code, done.stderr
    assert (done.stdout or done.stderr or words is TINY) and not (tmp_path / "imported").exists()


FAILS = {  # what a module says -> what the one line says
    "import sys\nsys.exit(0)\n": "does not load (SystemExit: 0)",
    "raise RuntimeError('no\\nsuch thing')\n": "does not load (RuntimeError: no such thing)",
    "S = 3\n": "is not a subclass of clsplat.Schedule",
    "from dataclasses import dataclass\nfrom clsplat import option\n@dataclass(frozen=True)\n"
    "class O:\n    seed: int = option(0, 'Run', 'mine')\n"
    + BASE
    + "    Options = O\n": "names seed, which clsplat has",
    BASE + "    defaults = {'nonsense': 1}\n": "unknown option 'nonsense'",
}


@pytest.mark.parametrize("text", FAILS)
@pytest.mark.one_in(4)
def test_what_fails_in_a_schedule_of_others_is_one_line_that_names_it(package, text):
    done = package(text, "x = module:S")(*TINY, "--schedule", "x")
    *before, line = done.stderr.splitlines()
    assert done.returncode == 2 and FAILS[text] in line, done.stderr
    assert not any("error: " in each or "Traceback" in each for each in before)


@pytest.mark.one_in(3)
def test_an_unknown_schedule_names_those_that_are_there(package):
    done = package("", "halves = module:S\nwrong = module:T")(*TINY, "--schedule", "nothing")
    assert done.returncode == 2 and "mcmc, halves, wrong" in done.stderr


LIGHT = "from clsplat import Part\nclass P(Part):\n    name = 'p'\n"
PART_FAILS = {
    "class P:\n    pass\n": "is not a subclass of clsplat.Part",
    LIGHT + "    Options = 3\n": "is not a frozen dataclass of options",
}


@pytest.mark.slow
@pytest.mark.parametrize("text", PART_FAILS)
@pytest.mark.one_in(4)
def test_what_fails_in_a_part_of_others_is_one_line_that_names_it(package, tmp_path, text):
    (tmp_path / "parts.toml").write_text("add-parts = ['x']")
    done = package(text, "x = module:P", "clsplat.parts")(*TINY, "--config", "parts.toml")
    assert done.returncode == 2 and PART_FAILS[text] in done.stderr.splitlines()[-1], done.stderr


@pytest.mark.slow
def test_a_part_in_one_file(package, tmp_path):
    """Its own flag, its records and its state; nothing imports it unless it is named."""
    clsplat = package(
        RECORD + (ROOT / "docs/examples/learned_scale.py").read_text(), "cauchy = module:CauchyLoss", "clsplat.parts"
    )
    assert clsplat(*TINY).returncode == 0 and not (tmp_path / "imported").exists()
    (tmp_path / "parts.toml").write_text("add-parts = ['cauchy']")
    done = clsplat(*TINY, "--overwrite", "--config", "parts.toml", "--cauchy-weight", "0.3", "--stop-at", "2")
    assert done.returncode == 130, done.stderr
    done = clsplat("train", "--resume", "-o", "run", "-q")
    assert done.returncode == 0, done.stderr
    options = json.loads((tmp_path / "run/options.json").read_text())
    assert options["add_parts"] == ["cauchy"] and options["cauchy_weight"] == 0.3
    records = [json.loads(line) for line in (tmp_path / "run/metrics.jsonl").open()]
    assert any(0 < record.get("cauchy_scale", 0) < 0.2 for record in records)
    done = clsplat("train", CITY, "--cauchy-weight", "0.3", "-o", "other")
    assert done.returncode == 2 and "--cauchy-weight" in done.stderr
    (tmp_path / "parts.toml").write_text("add-parts = ['nothing']")
    done = clsplat("train", CITY, "--config", "parts.toml", "-o", "other")
    assert done.returncode == 2 and "(cauchy), not 'nothing'" in done.stderr
