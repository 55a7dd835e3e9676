"""Reports of runs whose options and metrics hold what nobody expects: a page is made of each."""

import re

import pytest
from click.testing import CliRunner

from clsplat.cli.main import main
from clsplat.errors import InputError
from clsplat.io.runs.run import RunFolder
from clsplat.report.run import renew_report, write_report
from tests.data.made_runs import made_records, made_run
from tests.evaluation.test_pictures import pictures
from tests.report.test_report import bare_run
from tests.report.test_survey_hostile import words_of

STEP = {"event": "step", "iteration": 100, "train_seconds": 1.0, "level": 1.0, "gaussians": 9,
        "loss": 0.5}
LATER = {**STEP, "iteration": 200, "train_seconds": 2.0, "loss": 0.25}
EVAL = {"event": "eval", "iteration": 100, "train_seconds": 1.0, "level": 1.0, "gaussians": 9,
        "psnr": 20.0, "psnr_cc": 21.0, "ssim": 0.5, "ssim_cc": 0.6, "views": 3}
AGAIN = {**EVAL, "iteration": 200, "train_seconds": 2.0, "psnr": 19.0, "psnr_cc": 20.0}
LONG = "x" * 100_000
# name -> (options, records, words that the page has)
RUNS = {
    "no records": ({}, [], ("has no records",)),
    "a plan alone": ({}, [{"event": "plan", "iteration": 0, "reasons": {"<b>": "x & y"}}],
                     ("&lt;b&gt;", "x &amp; y")),
    "one evaluation": ({}, [STEP, LATER, EVAL], ("20.00 dB (poor)", "<h2>Scores</h2>")),
    "scores that were not finite": ({}, [{**EVAL, "psnr": None, "psnr_cc": None}],
                                    ("<td class=number>-</td>",)),
    "plain scores alone": ({}, [{"event": "eval", "psnr": 20.0}], ("20.00 dB (poor)",)),
    "fitted scores alone": ({}, [{"event": "eval", "psnr_cc": 28.0}], ("28.00 dB (very good)",)),
    "learned exposures without a fitted score": (
        {}, [{"event": "eval", "psnr": 20.0, "exposure_weight": 0.5}], ("A model of 0",)),
    "a negative PSNR": ({}, [{**EVAL, "psnr": -3.5}], ("-3.50 dB (poor)",)),
    "a huge PSNR": ({}, [{**EVAL, "psnr": 1e14}, {**AGAIN, "psnr": 1e14}], ("(very good)",)),
    "no time": ({}, [{"event": "reset", "iteration": 9}, {"event": "level", "level": 2.0},
                     {"event": "grow", "cloned": 1}, EVAL, AGAIN], ("Scores over training time",)),
    "nulls everywhere": ({}, [{**dict.fromkeys(STEP), "event": event} for event in (
        "step", "grow", "level", "reset", "eval", "plan", "warning")], ("A model of 0",)),
    "growth of nothing": ({}, [EVAL, {"event": "grow", "iteration": 190, "cloned": None,
                                      "split": None}, AGAIN], ("19.00 dB (poor)",)),
    "a fall": ({}, [EVAL, {**EVAL, "event": "grow", "iteration": 190, "cloned": 3}, AGAIN],
               ("The scores fall at step 200: gaussians just added",)),
    "time that runs backwards": ({}, [EVAL, {**AGAIN, "train_seconds": 0.5}], ("19.00 dB (poor)",)),
    "the same time twice": ({}, [EVAL, EVAL], ("<h2>Scores</h2>",)),
    "an event of another version": ({}, [{**STEP, "event": "dance"}, LATER], ("9 gaussians",)),
    "a level of 1e9": ({}, [{**STEP, "level": 1e9}, {**LATER, "event": "level"}, LATER],
                       ("1e+09 → 1",)),
    "a reason that is no text": ({}, [{"event": "level", "reason": "\ud800", "level": 1.0}],
                                 ("\\ud800",)),
    "names with markup": ({"scene": "/data/<script>x</script>", "schedule": "<i>"}, [STEP],
                          ("Schedule &lt;i&gt;",)),
    "a name that is no text": ({"scene": "/data/\udcff"}, [STEP], ("%FF: run",)),
    "no scene": ({"scene": None}, [STEP], ("<h1>run</h1>",)),
    "a very long value": ({"images": LONG}, [STEP], (f"<td>{LONG}</td>",)),
    "a value that is a tree": ({"decisions": {"levels": [[1], {"a": None}]}}, [STEP],
                               ("[[1], {&#x27;a&#x27;: None}]",)),
    "a schedule that is not installed": ({"schedule": "halves"}, [STEP], ("Schedule halves",)),
    "unknown scores": ({}, [{**EVAL, "views": None}], ("PSNR on held-out views:",)),
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
    assert "could not be" not in html and "<script" not in html
    assert not re.search(r"\b(nan|inf)\b", html)


@pytest.mark.slow
def test_thousands_of_evaluations_and_rounds(tmp_path):
    run = RunFolder.create(tmp_path / "run")
    run.write_options({})
    with open(run.path / "metrics.jsonl", "w", encoding="utf-8") as file:
        for number in range(3000):
            for record in (EVAL, {"event": "grow", "cloned": 1}, {"event": "reset"}):
                file.write(str({**EVAL, **record, "iteration": number, "psnr": 20.0 + number % 2,
                                "train_seconds": float(number)}).replace("'", '"') + "\n")
    html = words_of(write_report(run).read_text("utf-8"))
    assert "could not be" not in html and html.count("The scores fall") == 1499


@pytest.mark.parametrize("command, damage, words", [
    ("compare", lambda run: (run.path / "metrics.jsonl").unlink(), "has metrics yet"),
    ("eval", lambda run: (run.path / "options.json").write_text("{"), "options.json: damaged"),
    ("compare", lambda run: (run.path / "metrics.jsonl").write_text("[1]\n"), "line 1 is damaged"),
    ("eval", lambda run: (run.path / "point_cloud.ply").unlink(), "no model yet"),
    ("eval", lambda run: None, "its scene /data/city no longer exists"),
    ("compare", lambda run: (run.path / "compare.html").mkdir(), "compare.html: cannot be written"),
    ("view", lambda run: None, "point_cloud.ply")])
@pytest.mark.one_in(3)
def test_a_damaged_run_is_refused_in_one_line(command, damage, words, tmp_path):
    run = made_run(tmp_path / "run")
    damage(run)
    done = CliRunner().invoke(main, [command, str(run.path)])
    last = done.output.strip().splitlines()[-1]
    assert done.exit_code == 2 and last.startswith("error: ") and words in last


def test_a_report_that_is_a_folder_is_refused(tmp_path):
    run = bare_run(tmp_path / "run")
    (run.path / "report.html").mkdir()
    with pytest.raises(InputError, match="report.html: cannot be written"):
        renew_report(run, pictures())


@pytest.mark.slow
def test_compare_of_runs_with_holes(tmp_path):
    for name, records in (("a", [EVAL, AGAIN]), ("b", [STEP]), ("c", list(made_records("sig")))):
        run = RunFolder.create(tmp_path / name)
        run.write_options({"schedule": name, "scene": "/data/<b>"})
        for record in records:
            run.log(record)
    done = CliRunner().invoke(main, ["compare", str(tmp_path)])
    assert done.exit_code == 0, done.output
    html = words_of((tmp_path / "compare.html").read_text("utf-8"))
    assert html.index("training, s") < html.index("PSNR cc, dB") and "&lt;b&gt;" in html
