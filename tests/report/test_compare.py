"""Comparisons: which runs belong together, the numbers, what is unfair; and campaigns."""

import json

import pytest

from clsplat.cli.campaign import combinations, run_campaign
from clsplat.errors import DeviceError, Interrupted
from clsplat.io.runs.run import RunFolder, find_runs
from clsplat.report import compare
from clsplat.report.groups import Trained, differing, equal, grouped, read_runs, warnings
from tests.command_line import clsplat_
from tests.data.made_runs import METHODS, made_run
from tests.refusals import refused
from tests.report.test_report import Balanced


def trained(name, points=((10, 20.0), (20, 24.0)), finished=True, **options):
    """A Trained with evaluations at (seconds, PSNR after the colour fit)."""
    records = [
        {
            "event": "eval",
            "iteration": 100 * number,
            "train_seconds": seconds,
            "gaussians": 1000 * number,
            "psnr_cc": psnr,
            "psnr": psnr - 1,
            "ssim": 0.8,
            "ssim_cc": 0.9,
        }
        for number, (seconds, psnr) in enumerate(points, 1)
    ]
    facts = {"scene": "/data/city", "fingerprint": "ab" * 32, "opencl_device": "H100", "seed": 0}
    return Trained(name, {**facts, **options}, records, finished)


def test_runs_that_differ_by_seed_are_one_group():
    runs = [
        trained("b", seed=1, schedule="sig", stop_at=5, device="gpu", eval_every=9),
        trained("a", seed=0, schedule="sig"),
        trained("c", seed=0, schedule="dash"),
    ]
    groups = grouped(runs)
    assert {name: [run.name for run in group] for name, group in groups.items()} == {"sig": ["a", "b"], "dash": ["c"]}


@pytest.mark.parametrize(
    "first, second, names",
    [
        ({}, {}, ["sig"]),
        ({"max_gaussians": 5}, {"max_gaussians": 7}, ["max gaussians 5", "max gaussians 7"]),
        ({"sphere": True}, {"sphere": False}, ["sphere true", "sphere false"]),
        ({}, {"opencl_device": "MI300"}, ["H100", "MI300"]),
        ({"commit": "a" * 40}, {"commit": "a" * 40 + "-dirty"}, ["commit aaaaaaaa", "commit aaaaaaaa-dirty"]),
        ({"reset_every": 1}, {"schedule": "dash"}, ["sig", "dash"]),  # one word tells them apart
        ({}, {"max_gaussians": 5}, ["max gaussians not recorded", "max gaussians 5"]),
    ],
)
def test_groups_are_named_by_what_tells_them_apart(first, second, names):
    runs = [trained("a", **{"schedule": "sig", **first}), trained("b", **{"schedule": "sig", **second})]
    assert list(grouped(runs)) == names


def test_options_that_a_schedule_does_not_use_are_left_out():
    runs = [
        trained("a", schedule="sig", sphere=True, rounds=12, near=0.5, taming_budget=15.0),
        trained("b", schedule="constant", sphere=True, rounds=99, near=0.5, taming_budget=15.0),
        trained("c", schedule="constant", sphere=False, rounds=12, near=0.5, seed=1),
    ]
    groups = grouped(runs)
    assert [len(group) for group in groups.values()] == [1, 2]  # b and c differ in nothing used
    assert differing(runs) == ["schedule"]
    assert "near" in equal(runs) and not {"sphere", "rounds", "taming_budget"} & set(equal(runs))
    assert "sphere" in equal(runs[:1]) and "taming_budget" not in equal(runs[:1])
    longer = grouped([*runs, trained("d", schedule="sig", sphere=False, rounds=12, near=0.5, taming_budget=15.0)])
    assert ("sphere", "true", "-", "false") in compare.different_table(longer).rows


@pytest.mark.parametrize(
    "change, words",
    [
        (
            {"fingerprint": "cd" * 32, "scene": "/data/barn"},
            "different scenes, so no score says which is better (scene: barn (cdcdcdcd) / city",
        ),
        ({"test_every": 9}, "so scores cannot be compared (test every: 9 / not recorded)"),
        ({"downscale": 2.0}, "so scores cannot be compared (downscale:"),
        ({"opencl_device": "MI300"}, "scores can be compared, times cannot (OpenCL device: H100"),
        ({"version": "9"}, "different versions of clsplat (version"),
        ({"finished": False}, "Not finished yet: b."),
        ({"seed": 3, "size": "L"}, "The groups have different seeds"),
    ],
)
def test_what_is_unfair_is_said(change, words):
    found = warnings(grouped([trained("a"), trained("b", **change)]))
    assert sum(words in sentence for sentence in found) == 1, found


def test_a_fair_comparison_has_no_warning():
    assert warnings(grouped([trained("a", schedule="sig"), trained("b", schedule="dash")])) == []


def test_numbers():
    groups = grouped(
        [
            trained("a", schedule="sig"),
            trained("b", ((8, 20.0), (16, 26.0)), schedule="sig", seed=1),
            trained("c", ((10, 23.5), (40, 25.0)), schedule="dash"),
        ]
    )
    result = compare.compare(groups, [22.0, 25.0])
    assert result["equal_seconds"] == 16
    sig, dash = result["groups"]
    assert [run["psnr_cc_at_equal_seconds"] for run in sig["runs"]] == [22.4, 26.0]
    assert sig["mean"]["psnr_cc"] == 25.0 and sig["deviation"]["psnr_cc"] == pytest.approx(2**0.5)
    assert sig["mean"]["psnr"] == 24.0 and sig["mean"]["train_seconds"] == 18
    assert [crossing["seconds"] for crossing in sig["runs"][0]["reached"]] == [15, None]
    assert [crossing["upper_bound"] for crossing in dash["runs"][0]["reached"]] == [True, False]
    assert dash["deviation"]["psnr_cc"] is None and dash["mean"]["gaussians"] == 2000
    assert result["different"] == ["schedule"] and result["equal"]["opencl_device"] == "H100"

    final, time = compare.final_table(result), compare.time_table(result)
    # what it costs stands before the scores, and only the main scores have their deviation
    assert final.rows[0] == (
        "sig",
        "2",
        "0, 1",
        "18.0 ± 2.8",
        "2,000",
        "25.00 ± 1.41",
        "24.00",
        "0.9000 ± 0.0000",
        "0.8000",
    )
    assert final.rows[1][3:6] == ("40.0", "2,000", "25.00")
    assert time.rows == [("sig", "12.8 ± 3.1", "1 of 2 runs", "24.20 ± 2.55"), ("dash", "≤ 10.0", "40.0", "23.80")]


def test_costs():
    costs = [{"event": "eval", "psnr_cc": 20.0 + i, "pixel_pairs": i * 10**9} for i in (1, 2)]
    counted = Trained("a", {"schedule": "sig"}, costs, True)
    groups = grouped([counted, trained("b", schedule="dash")])
    assert [row[5] for row in compare.final_table(compare.compare(groups)).rows] == ["2e+09", "-"]


def test_scores_that_only_some_runs_have():
    def heads(*runs):
        return compare.final_table(compare.compare(grouped(runs))).head

    run = trained("a", schedule="sig")
    assert heads(run)[4:] == ("gaussians", "PSNR cc, dB", "PSNR, dB", "SSIM cc", "SSIM")
    run.records[-1].update(flip=0.125, flip_cc=0.0625)
    assert heads(run)[8:] == ("SSIM", "FLIP cc", "FLIP")
    groups = grouped([run, trained("b", schedule="dash")])
    assert [row[9:] for row in compare.final_table(compare.compare(groups)).rows] == [("0.0625", "0.1250"), ("-", "-")]


def test_a_run_without_evaluations():
    groups = grouped([trained("a", schedule="sig"), trained("b", (), schedule="dash")])
    result = compare.compare(groups, [21.0])
    assert any("not evaluated" in found and "b" in found for found in result["warnings"])
    assert result["equal_seconds"] == 20
    time = compare.time_table(result)
    assert time.rows[1] == ("dash", "0 of 1 runs", "0 of 1 runs")
    alone = compare.compare(grouped([trained("b", ())]))
    assert alone["levels"] == [] and alone["equal_seconds"] is None
    assert compare.time_table(alone).rows[0][1:] == ("0 of 1 runs",)


@pytest.mark.parametrize(
    "best, levels",
    [
        ([[28.7], [27.4]], [26.0, 27.0, 28.5]),
        ([[28.7, 27.1], [27.6]], [26.0, 27.0, 27.5]),
        ([[27.3], [27.4]], [25.0, 26.0, 27.0]),
        ([[30.0], []], [28.0, 29.0, 30.0]),
        ([[]], []),
    ],
)
def test_levels_from_the_data(best, levels):
    groups = [[(None, [20.0, psnr]) for psnr in group] for group in best]
    assert compare.levels_from(groups) == levels


@pytest.fixture
def folder(tmp_path):
    for schedule in METHODS:
        for seed in range(2):
            made_run(tmp_path / "cmp" / f"{schedule}.{seed}", schedule, seed)
    return tmp_path / "cmp"


def test_runs_are_found_two_levels_down(folder):
    assert len(find_runs(folder)) == len(find_runs(folder.parent)) == 8
    assert [run.path for run in find_runs(folder / "sig.0")] == [folder / "sig.0"]
    refused(lambda: find_runs(folder / "sig.0" / "none"), "holds no run")
    runs, parent, empty = read_runs([folder / "sig.0", folder / "dash.1", folder / "sig.0"])
    assert [run.name for run in runs] == ["sig.0", "dash.1"] and parent == folder and not empty
    assert read_runs([folder / "sig.0"])[0][0].name == "sig.0"


@pytest.mark.slow
def test_the_command(folder):
    started = RunFolder.create(folder / "sig.2")
    started.write_options({"schedule": "sig"})
    done = clsplat_("compare", folder, "--psnr", 27, "--psnr", 40)
    assert done.exit_code == 0, done.output
    assert "to 27 dB, s  to 40 dB, s" in done.output
    assert "they have no records yet: sig.2" in done.output
    # what matters most comes last
    assert done.output.startswith("What differs\n") and "sphere" not in done.output
    assert done.output.index("At the end\n") < done.output.index("Against training time")
    assert done.output.rstrip().endswith(f"page: {folder / 'compare.html'}")
    html = (folder / "compare.html").read_text()
    assert Balanced(html).charts == 1
    assert "<td class=number>0 of 2 runs" in html
    order = [
        html.index(words)
        for words in (
            'class="chart"',
            "class=warning",
            "At the end",
            "Against training time",
            "What differs",
            "<summary>What is equal",
        )
    ]
    assert order == sorted(order)
    numbers = json.loads((folder / "compare.json").read_text())
    assert [group["name"] for group in numbers["groups"]] == sorted(METHODS)
    run = next(run for group in numbers["groups"] for run in group["runs"] if run["folder"] == "sig.1")
    last = RunFolder.open(folder / "sig.1").records()[-1]
    assert run["psnr_cc"] == last["psnr_cc"] and run["train_seconds"] == last["train_seconds"]


def test_combinations():
    wanted = combinations({"levels": [4, 2, 1]}, {"seed": 3, "taming_budget": 9.0}, "sig,constant,taming", 2)
    assert [(o.schedule, o.seed) for o in wanted] == [
        ("sig", 3),
        ("constant", 3),
        ("taming", 3),
        ("sig", 4),
        ("constant", 4),
        ("taming", 4),
    ]
    assert [o.levels for o in wanted[:3]] == [(4, 2, 1), (), ()]
    assert [o.taming_budget for o in wanted[:3]] == [15, 15, 9]
    assert [o.reset_every for o in wanted[:2]] == [0, 3000]  # each as that schedule chooses
    refused(lambda: combinations({}, {"levels": (4, 2, 1)}, "constant,dash", 1), "levels")
    refused(lambda: combinations({}, {}, "sig,nosuch", 1), "nosuch")
    refused(lambda: combinations({}, {}, "sig,sig", 1), "twice")
    refused(lambda: combinations({}, {"stop_at": 5}, "sig", 1), "--stop-at")


class Trainer:
    """Stands for a training: notes its calls, writes a made-up run or fails."""

    def __init__(self, failures=()):
        self.calls, self.failures = [], dict(failures)

    def __call__(self, folder, options):
        self.calls.append((folder.name, options is None))
        if folder.name in self.failures:
            raise self.failures[folder.name]
        made_run(folder, options.schedule, options.seed, iterations=options.iterations)


@pytest.fixture
def wanted():
    return combinations({"iterations": 10_000}, {}, "sig,dash", 2)


@pytest.mark.slow
def test_a_campaign_goes_on_where_it_ended(tmp_path, wanted):
    made_run(tmp_path / "sig.0", "sig", 0)
    started = made_run(tmp_path / "dash.0", "dash", 0, finished=False, checkpoint_every=7)
    started.save_checkpoint({}, {})
    made_run(tmp_path / "sig.1", "sig", 1, finished=False)  # killed before its first checkpoint

    def train(folder, options):
        calls.append((folder.name, options is None))
        folder.mkdir(exist_ok=True)
        (folder / "point_cloud.ply").write_text("ply")
        if folder.name == "dash.1":
            made_run(tmp_path / "x", "dash", 1).path.joinpath("options.json").rename(folder / "options.json")
            (tmp_path / "x" / "metrics.jsonl").rename(folder / "metrics.jsonl")

    calls = []
    run_campaign(train, wanted, tmp_path)
    assert calls == [("dash.0", True), ("sig.1", False), ("dash.1", False)]


@pytest.mark.slow
def test_a_run_that_fails_does_not_stop_the_others(tmp_path, wanted, capsys):
    trainer = Trainer({"dash.0": DeviceError("no memory")})
    refused(lambda: run_campaign(trainer, wanted, tmp_path), "dash.0", "1 of 4")
    assert trainer.calls == [(name, False) for name in ("sig.0", "dash.0", "sig.1", "dash.1")]
    heard = capsys.readouterr()
    assert "failed: no memory" in heard.err and "[4/4]" in heard.out
    assert "Against training time" in heard.out and (tmp_path / "compare.html").exists()


def test_an_interrupted_campaign_stops(tmp_path, wanted):
    trainer = Trainer({"dash.0": Interrupted("stopped")})
    with pytest.raises(Interrupted, match="the same command"):
        run_campaign(trainer, wanted, tmp_path)
    assert len(trainer.calls) == 2
