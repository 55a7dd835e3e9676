"""The tools that make evidence: which runs they start, what serves again, and their numbers."""

import dataclasses
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

from clsplat.errors import InputError
from clsplat.io.runs.run import MODEL, RunFolder
from clsplat.report.page import Table
from clsplat.training.frequency import AXES, VARIANTS
from tools.studies import effectiveness, evidence, runs

CITY = Path(__file__).resolve().parents[2] / "data_samples" / "city"
SECONDS = {"sig": 10.0, "constant": 20.0, "dash": 15.0, "taming": 25.0}  # of a made-up run


@pytest.fixture
def trainings(monkeypatch, tmp_path):
    """The TrainOptions and environment of each run started; a run ends at once, with 30 dB and the
    tenth of its seed, or fails where `fails` says so of its options."""
    started = SimpleNamespace(options=[], environments=[], ways=[], meet=lambda: None,
                              fails=lambda options: False)

    def run(command, check, env):
        context = runs.train.make_context("train", command[4:])
        options = runs.resolve({}, runs.given_options(context))
        started.meet()
        started.options.append(options)
        started.environments.append(env)
        started.ways.append(command[-2])
        folder = RunFolder.create(context.params["output"], overwrite=True)
        folder.write_options({**dataclasses.asdict(options), "scene": context.params["scene"]})
        if started.fails(options):
            folder.save_checkpoint({}, {})
            return SimpleNamespace(returncode=2)
        for record in made_records(options):
            folder.log(record)
        (folder.path / MODEL).write_text("ply")
        return SimpleNamespace(returncode=0)

    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setattr(runs, "subprocess", SimpleNamespace(run=run))
    return started


def made_records(options):
    for step in sorted({*range(100, options.iterations + 1, 100), *options.eval_at}):
        share = step / options.iterations
        sharp = min(1, 2 * share) / options.downscale  # rises while densifying, then stays
        head = {"iteration": step, "train_seconds": share * SECONDS[options.schedule],
                "gaussians": 1000 * len(options.schedule)}
        yield {**head, "event": "step", "frequency": {
            f"{variant}_{axis}": sharp for variant in VARIANTS for axis in AXES}}
        if step in options.eval_at or share == 1:
            psnr = 30 + options.seed / 10 - 10 * (1 - share)
            yield {**head, "event": "eval", "views": 4, "psnr_cc": psnr, "psnr": psnr - 1,
                   "ssim": 0.8, "ssim_cc": 0.9}


def study(*words, seeds=1, columns=None):
    """Train what a small study needs, and write its page."""
    made = evidence.parser("A study.", 7000)
    arguments = evidence.parsed(made, [str(word) for word in words])
    columns = columns or {name: ["--schedule", name] for name in ("sig", "constant")}
    groups, failed = runs.trained(
        [runs.planned(arguments, scene, name, seed, flags) for seed in range(seeds)
         for scene in arguments.scenes for name, flags in columns.items()],
        arguments.jobs, arguments.gpus)
    evidence.write(arguments.out / "study.md", "Study", arguments, groups, [])
    evidence.refuse(failed)
    return groups


def test_a_study_trains_what_is_missing(tmp_path, trainings, capsys):
    words = [tmp_path, f"{CITY}:2", "-n", "1000", "--", "--near", "0.5"]
    columns = {"sig": [], "constant": ["--schedule", "constant"], "tuned": ["--rounds", "3"]}
    groups = study(*words, seeds=2, columns=columns)
    assert [(o.schedule, o.seed, o.rounds) for o in trainings.options] == [
        ("sig", 0, 12), ("constant", 0, 12), ("sig", 0, 3),
        ("sig", 1, 12), ("constant", 1, 12), ("sig", 1, 3)]
    assert {(o.iterations, o.downscale, o.near) for o in trainings.options} == {(1000, 2.0, 0.5)}
    assert {name: len(of_group) for name, of_group in groups["city-r2"].items()} == {
        "sig": 2, "constant": 2, "tuned": 2}
    written = (tmp_path / "study.md").read_text()
    assert "1,000 steps, 6 runs, at most 1 at a time" in written and "--near 0.5" in written
    capsys.readouterr()
    study(*words, seeds=2, columns={"another name": columns["tuned"]})
    assert len(trainings.options) == 6
    assert "2 runs, 2 of them finished before" in capsys.readouterr().out


def test_runs_share_the_gpus_evenly(tmp_path, trainings):
    trainings.meet = threading.Barrier(2, timeout=120).wait  # two at a time, or it breaks
    study(tmp_path, CITY, "-n", "100", "--gpus", "2", seeds=2)
    used = [environment["CUDA_VISIBLE_DEVICES"] for environment in trainings.environments]
    assert sorted(used) == ["0", "0", "1", "1"] and set(used[:2]) == {"0", "1"}
    assert len({environment["POCL_CACHE_DIR"] for environment in trainings.environments}) == 2


def test_a_failed_run_leaves_the_others_and_is_told_at_the_end(tmp_path, trainings):
    trainings.fails = lambda options: options.schedule == "sig" and options.downscale == 2
    words = [tmp_path, CITY, f"{CITY}:2", "-n", "100"]
    with pytest.raises(InputError, match="city-r2/sig.0: failed"):
        study(*words)
    assert "100 steps, 3 runs" in (tmp_path / "study.md").read_text()
    trainings.fails = lambda options: False
    study(*words)  # goes on with that one, from its checkpoint
    assert trainings.ways == ["--overwrite"] * 4 + ["--resume"]
    assert "100 steps, 4 runs" in (tmp_path / "study.md").read_text()


@pytest.mark.parametrize("words, complaint", [
    ([CITY, "-n", "300"], "iterations 200, not 300"),
    ([CITY, "-n", "200", "--", "--eval-at", "150"], r"eval_at \[50\], not \[150\]"),
    ([CITY / "nothing"], "no such scene"),
    ([CITY, CITY], "would hold two runs"),
    ([CITY, "--", "--rounds", "5"], "has no effect with"),
])
def test_what_cannot_be_is_refused_before_any_training(tmp_path, trainings, words, complaint):
    columns = {"constant": ["--schedule", "constant"]}
    study(tmp_path, CITY, "-n", "200", "--", "--eval-at", "50", columns=columns)
    with pytest.raises(InputError, match=complaint):
        study(tmp_path, *words, columns=columns)
    assert len(trainings.options) == 1


@pytest.mark.slow
def test_effectiveness_orders_the_resolutions(tmp_path, trainings):
    effectiveness.main([str(tmp_path), f"{CITY}:2", "-n", "1000", "--", "--densify-from", "100"])
    assert [(o.downscale, o.schedule, o.reset_every) for o in trainings.options] == [
        (2.0 * factor, "constant", 0) for factor in (5, 4, 3, 2, 1)]
    written = (tmp_path / "effectiveness.md").read_text()
    assert written.count("| yes | yes | yes | 0.00 (0.00 to 0.00) | 0.1 0.125 0.167 0.25 0.5 |"
                         ) == 9
    assert (tmp_path / "city-r2" / "effectiveness.png").stat().st_size > 10_000


def test_a_frequency_that_goes_on_rising_or_is_out_of_order_is_told():
    rising = [0, 100, 200, 300, 400], [0, 1, 2, 3, 4]
    assert effectiveness.late_share(rising, 400, (0, 200)) == pytest.approx(0.5)
    assert effectiveness.late_share(rising, 400, (200, 200)) is None
    assert effectiveness.ordered([1, 3, 2, 4]) == "2 of 3"
    higher_at_half = [0, 100, 200, 400], [0, 0.5, 3, 3]
    assert effectiveness.verdicts([rising, higher_at_half], (0, 200)) == (
        "0 of 1", "yes", "1 of 2", "0.25 (0.00 to 0.50)", "4 3")


def test_a_table_is_markdown():
    assert evidence.markdown(Table("T", ("a", "b"), [("x|y", "1")], (1,), ("Note.",))) == (
        "### T\n\n| a | b |\n| --- | ---: |\n| x/y | 1 |\n\nNote.")


@pytest.mark.slow
def test_a_real_run_is_read(tmp_path):
    (run,), = study(tmp_path, f"{CITY}:4", "-n", "5", columns={
        "constant": ["--schedule", "constant"]})["city-r4"].values()
    assert run.records[-1]["event"] == "eval" and run.records[-1]["iteration"] == 5
