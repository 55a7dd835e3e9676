"""Training on the sample city: it learns, grows as promised, and records what it does."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from clsplat.io.models.ply import read_ply
from clsplat.io.runs.run import RunFolder
from clsplat.loss.exposure import Exposures
from clsplat.training import run as trainings
from clsplat.training.frequency import AXES, VARIANTS
from clsplat.training.photos import epoch_order
from clsplat.training.progress import SilentProgress
from clsplat.training.step import Step
from tests.data.tiny_training import CITY, STILL, options_of, records, trained

COMMON = ["event", "iteration", "train_seconds", "wall_seconds", "level", "gaussians", "pixel_pairs"]


def test_it_learns(item_device, city, tmp_path):
    """Measured: 22.3 dB; the photos' own mean colour gives 15."""
    learns(trained(tmp_path / "run", city, item_device, **STILL, iterations=200))


def learns(run):
    losses = [record["loss"] for record in records(run, "step")]
    assert losses[0] > 0.25 and losses[1] < 0.5 * losses[0] and losses[2] < 0.9 * losses[1]
    scores = records(run, "eval")[-1]
    assert scores["psnr"] > 21.3 and scores["psnr_cc"] > 22.1
    assert scores["ssim"] > 0.75 and scores["ssim_cc"] > 0.74
    assert scores["views"] == 4


@pytest.mark.slow
def test_growth_is_recorded_and_adds_up(eventful, city):
    rounds = records(eventful, "grow")
    assert [record["iteration"] for record in rounds] == [41, 61, 81, 101]
    count = len(city.points)
    for record in rounds:
        count += record["cloned"] + record["split"] - record["pruned"]
        assert record["gaussians"] == count
    assert all(sum(record[kind] for record in rounds) > 0 for kind in ("cloned", "split", "pruned"))
    assert read_ply(eventful.path / "point_cloud.ply").count == count


@pytest.mark.slow
def test_max_gaussians_is_reached_and_never_passed(item_device, city, tmp_path):
    cap = len(city.points) + 600
    run = trained(tmp_path / "run", city, item_device, max_gaussians=cap, prune_opacity=0.0)
    counts = [record["gaussians"] for record in records(run, "grow")]
    assert len(counts) == 4 and max(counts) == cap and min(counts) > cap - 20, counts


def test_harmonics_stay_at_zero_until_their_degree(item_device, city, tmp_path):
    run = trained(tmp_path / "run", city, item_device, **STILL, iterations=30, sh_every=20)
    rest = read_ply(run.path / "point_cloud.ply").sh_rest
    assert rest[:, :3].any() and not rest[:, 3:].any()


def evaluated(run):
    return [record["iteration"] for record in records(run, "eval")]


@pytest.mark.parametrize(
    "options, expected",
    [({}, [30]), ({"eval_every": 10}, [10, 20, 30]), ({"test_every": 0, "eval_every": 10}, []), ({"stop_at": 12}, [])],
)
@pytest.mark.slow
def test_evaluations(item_device, city, tmp_path, options, expected):
    assert evaluated(trained(tmp_path / "run", city, item_device, **STILL, iterations=30, **options)) == expected


@pytest.mark.slow
def test_a_batch_takes_the_next_views_of_the_epochs(item_device, city, tmp_path, monkeypatch):
    """Each view as often as any other, and recentred once an epoch: 28 steps of 3 on 28 views. The
    loss is that of all three."""
    seen, recentred, losses, take = [], [], [], Step.run

    def watched(step, iteration, plan, shots, upcoming):
        shots = list(shots)
        seen.append([shot.view for shot in shots])
        found = take(step, iteration, plan, shots, upcoming)
        losses.append([step.values([one])["loss"] for one in found])
        return found

    monkeypatch.setattr(Step, "run", watched)
    monkeypatch.setattr(Exposures, "recentre", lambda _: recentred.append(len(seen)))
    options = {**STILL, "batch": 3, "exposure": "on"}
    run = trained(tmp_path / "run", city, item_device, **options, iterations=28)
    assert {len(views) for views in seen} == {3} and recentred == [0, 10, 19]
    order = [epoch_order(options_of().seed, epoch, np.ones(28)).tolist() for epoch in range(3)]
    assert sum(seen, []) == sum(order, [])
    assert (np.bincount(sum(seen, [])) == 3).all()
    assert records(run, "step")[0]["loss"] == pytest.approx(np.mean(losses[0])) != losses[0][0]


@pytest.mark.slow
def test_records_carry_what_reports_read(eventful):
    run = eventful
    every = run.records()
    assert {record["event"] for record in every} == {"plan", "step", "grow", "reset", "eval", "time"}
    for record in every:
        assert list(record)[: len(COMMON)] == COMMON
        assert record["level"] == 1.0
    assert 0 <= every[0]["train_seconds"] < every[0]["wall_seconds"] / 2, "preparing is no training"
    for earlier, later in pairwise(every):
        for key in ("iteration", "train_seconds", "wall_seconds", "pixel_pairs"):
            assert earlier[key] <= later[key]
        assert later["train_seconds"] <= later["wall_seconds"]
    own = {event: set(records(run, event)[-1]) - set(COMMON) for event in ("plan", "step", "grow", "reset", "eval")}
    assert own == {
        "plan": {"reasons", "levels", "format"},
        "step": {
            "loss",
            "l1",
            "ssim",
            "memory_bytes",
            "peak_bytes",
            "skipped_rows",
            "skipped_since",
            "frequency",
            "convergence",
        },
        "grow": {"cloned", "split", "pruned"},
        "reset": set(),
        "eval": {"psnr", "ssim", "psnr_cc", "ssim_cc", "views"},
    }
    assert [record["iteration"] for record in records(run, "step")] == [1, 100]
    step = records(run, "step")[-1]
    assert step["skipped_rows"] == 0 and step["memory_bytes"] > 1e6
    assert step["loss"] == pytest.approx(0.8 * step["l1"] + 0.2 * (1 - step["ssim"]))


@pytest.mark.slow
def test_levels_and_frequencies_are_recorded(levelled):
    (plan,) = records(levelled, "plan")
    assert levelled.records()[0] == plan and plan["iteration"] == 0
    assert plan["levels"] == [2.0, 1.0] and set(plan["reasons"]) == set(
        "steps init levels gaussians sh_degree exposure vignetting robust reproject engine".split()
    )
    (level,) = records(levelled, "level")
    assert set(level) - set(COMMON) == {"reason", "since", "rounds", "frequency", "slope", "threshold", "hits"}
    assert level["level"] == 1.0 and level["since"] == level["iteration"]
    every = levelled.records()
    place = every.index(level)  # after all records of the step before it, which had the old level
    assert {record["level"] for record in every[:place]} == {2.0}
    assert {record["level"] for record in every[place:]} == {1.0}
    assert all(record["iteration"] > level["iteration"] for record in every[place + 1 :])
    first, later = records(levelled, "step")
    assert (first["iteration"], later["iteration"]) == (1, 100) and first["frequency"] is None
    assert set(later["frequency"]) == {f"{variant}_{axis}" for variant in VARIANTS for axis in AXES}
    assert all(value > 0 for value in later["frequency"].values())
    assert later["convergence"] is None  # at the finest level nothing is judged


def test_the_run_knows_how_it_was_made(item_device, city, tmp_path):
    run = trained(tmp_path / "run", city, item_device, **STILL, iterations=30, seed=3)
    options = run.read_options()
    assert options["seed"] == 3 and options["iterations"] == 30
    assert options["scene_absolute"] == str(CITY) and len(options["fingerprint"]) == 64
    assert options["opencl_device"] == item_device.name and options["kernel_form"] == "item"
    assert options["kernel_sizes"] == item_device.tuning
    assert {"version", "commit", "extent", "offset"} <= set(options)


def test_progress_is_told(item_device, city, tmp_path):
    class Progress(SilentProgress):
        told, messages, phases = [], [], []

        def __call__(self, **values):
            self.told.append(values)

        def message(self, text):
            self.messages.append(text)

        def phase(self, text):
            super().phase(text)
            self.phases.append(text)

    trainings.train(
        city, options_of(iterations=60, **STILL), item_device, RunFolder.create(tmp_path / "run"), Progress()
    )
    assert [values["iteration"] for values in Progress.told] == [1, 50]
    assert list(dict.fromkeys(Progress.phases)) == [
        "planning",
        "reading photos",
        "reading photos at full size",
        "compiling kernels",
        "training at full size",
        "writing the model",
        "evaluating",
        "writing the report",
    ]
    assert set(Progress.told[0]) == {"iteration", "total", "loss", "gaussians", "memory_bytes", "level"}
    assert {values["total"] for values in Progress.told} == {60}
    lines = Progress.messages[0].splitlines()
    assert len(Progress.messages) == 1 and lines[0] == "scores of 4 held-out photos"
    assert lines[1].split() == ["step", "PSNR,", "dB", "SSIM", "gaussians", "training"]
    assert lines[2].split()[0] == "60" and max(map(len, lines)) < 80


@pytest.mark.slow
def test_growth_helps(item_device, city, tmp_path):
    """To fit the photos, where points are few: every fortieth of the city's."""
    thin = replace(city, points=city.points[::40], colours=city.colours[::40], observations=None)
    runs = [
        trained(tmp_path / name, thin, item_device, iterations=400, reset_every=0, **changes)
        for name, changes in (("still", {"densify_from": 1000}), ("grown", {"densify_from": 50, "densify_until": 200}))
    ]
    still, grown = (records(run, "step")[-1]["loss"] for run in runs)
    assert grown < 0.85 * still, (still, grown)


@pytest.mark.slow
def test_opacities_are_reset(item_device, city, tmp_path):
    """One step after the reset behind step 50 nothing is opaque; without a reset much is."""
    opacities = []
    for every in (50, 0):
        run = trained(tmp_path / str(every), city, item_device, iterations=52, reset_every=every)
        logits = read_ply(run.path / "point_cloud.ply").opacity_logits
        opacities.append(1 / (1 + np.exp(-logits)))
    assert opacities[0].max() < 0.02 and opacities[1].max() > 0.2
