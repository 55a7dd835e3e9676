"""The tools that make evidence: which runs they start, what serves again, and their numbers."""

import dataclasses
import math
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

from clsplat.errors import InputError
from clsplat.io.run import MODEL, RunFolder
from clsplat.report.groups import Trained
from clsplat.report.page import Table
from clsplat.training.frequency import AXES, VARIANTS
from tools.studies import ablate, effectiveness, evidence, matrix, runs

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


def test_a_matrix_trains_what_is_missing_and_says_how_it_compares(tmp_path, trainings, capsys):
    words = [str(tmp_path), f"{CITY}:2", "-n", "1000", "--seeds", "2", "--eval-at", "400,5000",
             "--schedules", "sig,constant", "--also", "tuned: --schedule sig --rounds 3", "--",
             "--near", "0.5"]
    matrix.main(words)
    assert [(o.schedule, o.seed, o.rounds) for o in trainings.options] == [
        ("sig", 0, 12), ("constant", 0, 12), ("sig", 0, 3),
        ("sig", 1, 12), ("constant", 1, 12), ("sig", 1, 3)]
    assert {(o.iterations, o.downscale, o.near, o.eval_at) for o in trainings.options} == {
        (1000, 2.0, 0.5, (400,))}
    written = (tmp_path / "matrix.md").read_text()
    # constant at 10 s is half done: between 24 dB at 8 s and 30 dB at 20 s, plus half a tenth
    assert "| constant | 2 | 30.05 ± 0.07 | 29.05 ± 0.07 | 0.9000 ± 0.0000 | 0.8000 ± 0.0000 | " \
        "8,000 ± 0 | 20.0 ± 0.0 | 25.05 ± 0.07 |" in written
    assert "| sig | 30.05 | 29.05 | 0.9000 | 0.8000 | 30.05 | +0.00 | 0.38 | 0.50 |" in written
    assert "| city-r2 | sig | 400 | 2 | 24.05 ± 0.07" in written
    capsys.readouterr()
    matrix.main(words)
    assert len(trainings.options) == 6
    assert "6 runs, 6 of them finished before" in capsys.readouterr().out
    ablate.main([str(tmp_path), f"{CITY}:2", "-n", "1000", "--seeds", "1", "--", "--near", "0.5"])
    assert [o.schedule for o in trainings.options[6:]] == ["sig"] * 7  # the full one was there
    flags = dict(zip(list(ablate.ROWS)[1:], trainings.options[6:]))
    assert flags["w/o FARS"].levels == (1,) and flags["w/o FARS"].rounds == 0
    assert flags["w/o DS"].levels == () and flags["w/o DS"].densify_every == 200
    assert not flags["w/o SCG"].sphere and flags["w/o SCG"].reproject == "off"
    assert flags["w/o ceiling"].pixels_per_gaussian == 0
    assert not flags["w/o level resets"].level_reset
    assert flags["and DR"].reproject == "auto" and flags["w/o exposure"].exposure == "off"


def test_runs_share_the_gpus_evenly(tmp_path, trainings):
    trainings.meet = threading.Barrier(2, timeout=20).wait  # two at a time, or it breaks
    matrix.main([str(tmp_path), str(CITY), "-n", "100", "--seeds", "2", "--gpus", "2",
                 "--schedules", "sig,constant"])
    used = [environment["CUDA_VISIBLE_DEVICES"] for environment in trainings.environments]
    assert sorted(used) == ["0", "0", "1", "1"] and set(used[:2]) == {"0", "1"}
    assert len({environment["POCL_CACHE_DIR"] for environment in trainings.environments}) == 2


def test_a_failed_run_leaves_the_others_and_is_told_at_the_end(tmp_path, trainings):
    trainings.fails = lambda options: options.schedule == "sig" and options.downscale == 2
    words = [str(tmp_path), str(CITY), f"{CITY}:2", "-n", "100", "--seeds", "1",
             "--schedules", "sig,constant"]
    with pytest.raises(InputError, match="city-r2/sig.0: failed"):
        matrix.main(words)
    written = (tmp_path / "matrix.md").read_text()
    assert "| sig | 0 | - | - |" in written and "### Means over 1 scene, " in written
    assert "1 left out" in written
    trainings.fails = lambda options: False
    matrix.main(words)  # goes on with that one, from its checkpoint
    assert trainings.ways == ["--overwrite"] * 4 + ["--resume"]
    assert "### Means over 2 scenes, " in (tmp_path / "matrix.md").read_text()


@pytest.mark.parametrize("words, complaint", [
    ([str(CITY), "-n", "300"], "iterations 200, not 300"),
    ([str(CITY), "-n", "200", "--eval-at", "150"], r"eval_at \[50\], not \[150\]"),
    ([str(CITY / "nothing")], "no such scene"),
    ([str(CITY), str(CITY)], "would hold two runs"),
    ([str(CITY), "--also", "sig"], "expects a name, a colon and flags"),
    ([str(CITY), "--", "--schedule", "sig", "--rounds", "5"], "has no effect with"),
])
def test_what_cannot_be_is_refused_before_any_training(tmp_path, trainings, words, complaint):
    matrix.main([str(tmp_path), str(CITY), "-n", "200", "--seeds", "1", "--eval-at", "50",
                 "--schedules", "constant"])
    with pytest.raises(InputError, match=complaint):
        matrix.main([str(tmp_path), "--seeds", "1", "--schedules", "constant", *words])
    assert len(trainings.options) == 1


def ended(*ends):
    return [Trained("", {}, [{"event": "eval", "iteration": 9, "psnr_cc": end}], True)
            for end in ends]


def test_the_difference_to_full_has_its_standard_error():
    value, error = ablate.difference(ended(31, 32, 33), ended(30, 30, 33, 33))
    assert value == pytest.approx(0.5)
    assert error == pytest.approx(math.sqrt(1 / 3 + 3 / 4))
    assert math.isnan(ablate.difference(ended(31), ended(30, 31))[1])
    scene = {name: ended(30, 32) for name in ablate.ROWS}
    table = ablate.mean_table({"a": scene, "b": {**scene, "w/o DS": ended(30, 34)}})
    # 0 ± sqrt(1 + 1) and 1 ± sqrt(1 + 4): mean 0.5 ± sqrt(7) / 2
    assert [row[3] for row in table.rows if row[0] == "w/o DS"] == ["+0.50 ± 1.32"]


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
    matrix.main([str(tmp_path), f"{CITY}:4", "-n", "5", "--seeds", "1", "--schedules", "constant"])
    assert "| city-r4 | constant | 5 | 1 |" in (tmp_path / "matrix.md").read_text()
