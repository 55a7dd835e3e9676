"""The judge of schedules: which runs it makes, what it keeps, and what its page says."""

import dataclasses
from types import SimpleNamespace

import pytest

from clsplat.errors import InputError
from clsplat.io.scenes.read import read_scene
from clsplat.io.scenes.write import write_scene
from tests.data.tiny_training import CITY
from tools.studies import judge

BASE = {"sig": 31.0, "constant": 30.0, "mcmc": 29.0}  # dB of a made-up run, at offset 0 and seed 0


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    """A folder of two sets."""
    folder = tmp_path_factory.mktemp("sets")
    city = read_scene(CITY)
    for name in ("one", "two"):
        write_scene(folder / name, city, downscale=16)
    return folder


@pytest.fixture
def trainings(monkeypatch):
    """The options of each training, which ends at once."""
    started = SimpleNamespace(options=[], fails=lambda options: False)

    def train(scene, given, *, output, device, overwrite):
        options = dataclasses.asdict(given)
        started.options.append({"set": scene.name, **options})
        if started.fails(options):
            raise InputError("it cannot be")
        output.mkdir(parents=True)
        return SimpleNamespace(
            metrics=made_records(scene.name, options),
            record={
                "opencl_device": "a device",
                "kernel_form": "item",
                "version": "0",
                "commit": 5 * "01234567" + "-dirty",
            },
        )

    monkeypatch.setattr(judge.clsplat, "train", train)
    monkeypatch.setattr(judge, "choose_device", lambda *_, **__: None)
    monkeypatch.setattr(
        judge, "further_scores", lambda made, device: {"flip": 0.2, "flip_cc": 0.1, "psnr_cc_seen": 32.0, "seen": 0.9}
    )
    return started


def made_records(name, options):
    """Three evaluations, of which the middle one is the best."""
    end = BASE[options["schedule"]] + options["test_offset"] / 10 + options["seed"] / 100 - 5 * (name == "two")
    for share, psnr in ((0.25, end - 4), (0.5, end + 0.3), (1.0, end)):
        yield {
            "event": "eval",
            "iteration": int(share * options["iterations"]),
            "train_seconds": 10 * share,
            "psnr_cc": psnr,
            "psnr": psnr - 1,
            "ssim": 0.8,
            "ssim_cc": 0.9,
            "views": 4,
            "gaussians": 1000,
        }


def judged(out, *words):
    judge.main([str(out), *map(str, words)])
    page = (out / "judge.md").read_text()
    return {
        tuple(row[:2]): row
        for row in (
            [part.strip() for part in line.strip("|").split("|")] for line in page.splitlines() if line.startswith("| ")
        )
    }, page


SMALL = ("-n", "100", "--offsets", "0,3", "--seeds", "2", "--schedules", "sig,constant,mcmc")


@pytest.mark.slow
def test_every_set_division_seed_and_schedule_once(tmp_path, sets, trainings, capsys):
    words = (sets, *SMALL, "--", "--exposure", "on", "--device", "cpu")
    _, page = judged(tmp_path, *words)
    ran = [(o["set"], o["test_offset"], o["seed"], o["schedule"]) for o in trainings.options]
    assert len(ran) == len(set(ran)) == 2 * 2 * 2 * 3
    assert {(o["iterations"], o["test_every"], o["exposure"]) for o in trainings.options} == {(100, 8, "on")}
    assert (
        "24 of 24 runs; a device; form item; commit 01234567-dirty; flags of all runs: --exposure on --device cpu"
    ) in page
    assert not list((tmp_path / "runs").iterdir())
    judged(tmp_path, *words)
    assert len(trainings.options) == 24
    assert "24 runs, 24 of them finished before" in capsys.readouterr().out
    # the same run under another name is there, other options are another run
    judged(
        tmp_path,
        sets,
        *SMALL[:6],
        "--schedules",
        "",
        "--baseline",
        "base",
        "--with",
        "base: --schedule constant",
        "--with",
        "more: --schedule sig --rounds 5",
        "--",
        "--exposure",
        "on",
    )
    assert [o["rounds"] for o in trainings.options[24:]] == [5] * 8


def test_the_page_says_how_they_compare(tmp_path, sets, trainings):
    rows, page = judged(tmp_path, sets, *SMALL, "--chosen", "one:0,two")
    assert "Choices were made on: one (offsets 0); two (offsets 0, 3)." in page
    assert "They are confirmed on: one (offsets 3)." in page
    # 31 and 26 dB at offset 0, 0.3 dB more at 3, 0.01 dB more for the second seed
    assert ("| sig | 8 | 28.66 | 27.66 | 0.9000 | 0.8000 | 32.00 | 0.1000 | 1,000 | 10.0 | 0.007 | two 26.16 |") in page
    assert "| mcmc | -1.00 ± 0.00 | -1.00 ± 0.00 | -1.00 | -1.00 ± 0.00 | one -1.00 | one -1.00 |" in page
    assert "| - (0 of 2) |" in page  # mcmc never gets so far
    assert "| sig | +1.00 ± 0.00 | +1.00 ± 0.00 | +1.00 | +1.00 ± 0.00 |" in page
    against = next(line for line in page.splitlines() if line.startswith("| sig | +1.00"))
    # its line from end - 4 to end + 0.3 reaches 1 dB less than its end at 3 / 4.3 of 2.5 s
    assert against.endswith(f"| 1.00 | 1.00 | {0.25 + 0.25 * 3 / 4.3:.2f} (2 of 2) | one 0.30 |")
    assert rows["two", "constant"][2:5] == ["4", "25.16", "24.16"]


def test_a_column_that_is_not_complete_is_left_out(tmp_path, sets, trainings):
    trainings.fails = lambda options: (options["schedule"], options["test_offset"]) == ("mcmc", 3)
    with pytest.raises(InputError, match="one 100 steps, offset 3, seed 0 mcmc .it cannot be."):
        judge.main([str(tmp_path), str(sets), *SMALL])
    page = (tmp_path / "judge.md").read_text()
    assert "### Means over 2 sets, 2 divisions" in page and "4 seeds of divisions are left" in page
    assert "| sig | 4 | 28.51 |" in page  # offset 0 alone
    trainings.fails = lambda options: False
    before = len(trainings.options)
    judged(tmp_path, sets, *SMALL)
    assert len(trainings.options) == before + 4


@pytest.mark.parametrize(
    "words, complaint",
    [
        (["--with", "sig"], "expects a name, a colon and flags"),
        (["--baseline", "dash"], "is not one of sig, constant, mcmc"),
        (["--chosen", "one,two:4"], "--chosen two:4: is no set of one, two, nor"),
        (["--every", "3", "--offsets", "3"], "must be less than --test-every"),
        (["--", "--rounds", "5"], "has no effect with"),
        (["--with", "group: --schedule sig --form group"], "--device and --form: give them after --"),
        (["--with", "cpu: --schedule sig --device cpu"], "--device and --form: give them after --"),
    ],
)
def test_what_cannot_be_is_refused_before_any_training(tmp_path, sets, trainings, words, complaint):
    with pytest.raises(InputError, match=complaint):
        judge.main([str(tmp_path), str(sets), *SMALL, *words])
    assert not trainings.options and not list(tmp_path.iterdir())
