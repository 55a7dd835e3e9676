"""Reports of runs whose options and metrics hold what nobody expects: a page is made of each."""

import re

import pytest
from click.testing import CliRunner

from clsplat.cli.main import main
from clsplat.io.runs.run import RunFolder
from clsplat.report.run import write_report
from tests.data.made_runs import made_run
from tests.report.test_survey_hostile import words_of

STEP = {"event": "step", "iteration": 100, "train_seconds": 1.0, "level": 1.0, "gaussians": 9,
        "loss": 0.5}
EVAL = {"event": "eval", "iteration": 100, "train_seconds": 1.0, "level": 1.0, "gaussians": 9,
        "psnr": 20.0, "psnr_cc": 21.0, "ssim": 0.5, "ssim_cc": 0.6, "views": 3}
AGAIN = {**EVAL, "iteration": 200, "train_seconds": 2.0, "psnr": 19.0, "psnr_cc": 20.0}
# name -> (options, records, words that the page has)
RUNS = {
    "no records": ({}, [], ("has no records",)),
    "a plan alone": ({}, [{"event": "plan", "iteration": 0, "reasons": {"<b>": "x & y"}}],
                     ("&lt;b&gt;", "x &amp; y")),
    "scores that were not finite": ({}, [{**EVAL, "psnr": None, "psnr_cc": None}],
                                    ("<td class=number>-</td>",)),
    "learned exposures without a fitted score": (
        {}, [{"event": "eval", "psnr": 20.0, "exposure_weight": 0.5}], ("A model of 0",)),
    "nulls everywhere": ({}, [{**dict.fromkeys(STEP), "event": event} for event in (
        "step", "grow", "level", "reset", "eval", "plan", "warning")], ("A model of 0",)),
    "a fall": ({}, [EVAL, {**EVAL, "event": "grow", "iteration": 190, "cloned": 3}, AGAIN],
               ("The scores fall at step 200: gaussians just added",)),
    "names with markup": ({"scene": "/data/<script>x</script>", "schedule": "<i>"}, [STEP],
                          ("Schedule &lt;i&gt;",)),
}


@pytest.mark.parametrize("name", RUNS)
@pytest.mark.one_in(5)
def test_any_run_has_a_page(name, tmp_path):
    options, records, words = RUNS[name]
    run = RunFolder.create(tmp_path / "run")
    known = {"scene": "/data/city", **options}
    run.write_options({key: value for key, value in known.items() if value is not None})
    (run.path / "metrics.jsonl").touch()
    for record in records:
        run.log(record)
    html = words_of(write_report(run).read_text("utf-8"))
    assert all(word in html for word in words), html[-4000:]
    assert "could not be" not in html and "<script>x" not in html
    assert not re.search(r"\b(nan|inf)\b", html)


@pytest.mark.parametrize("command, damage, words", [
    ("eval", lambda run: (run.path / "options.json").write_text("{"), "options.json: damaged"),
    ("compare", lambda run: (run.path / "metrics.jsonl").write_text("[1]\n"), "line 1 is damaged"),
    ("compare", lambda run: (run.path / "compare.html").mkdir(), "compare.html: cannot be")])
@pytest.mark.one_in(3)
def test_a_damaged_run_is_refused_in_one_line(command, damage, words, tmp_path):
    run = made_run(tmp_path / "run")
    damage(run)
    done = CliRunner().invoke(main, [command, str(run.path)])
    last = done.output.strip().splitlines()[-1]
    assert done.exit_code == 2 and last.startswith("error: ") and words in last
