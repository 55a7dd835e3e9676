"""Trainings whose length is a time: they keep it, and end with a good model."""

import pytest

from clsplat.errors import Interrupted
from clsplat.io.runs.run import RunFolder
from clsplat.options import resolve
from clsplat.training import budget
from clsplat.training import run as trainings
from tests.data.tiny_training import EVENTFUL, LEVELLED, records, trained


@pytest.mark.slow
@pytest.mark.alone
@pytest.mark.parametrize("options", [{}, {**LEVELLED, "visits": 0.0}], ids=["constant", "sig"])
def test_a_time_budget_is_kept_across_a_stop(item_device, city, tmp_path, options):
    """On a machine that others use too: see tests/training/test_budget.py for how well. Sig would
    end at the most steps that its photos allow, long before."""
    options = {key: value for key, value in {**EVENTFUL, **options}.items() if key != "iterations"}
    options = {**options, "time_budget": "12s"}
    run = RunFolder.create(tmp_path / "run")
    with pytest.raises(Interrupted):
        trainings.train(city, resolve({}, {**options, "stop_at": 90}), item_device, run)
    before = run.load_checkpoint()[1]
    trainings.resumed(city, resolve({}, options), item_device, RunFolder.open(run.path)).take()
    last = records(run, "eval")[-1]
    assert 12 * 0.6 < last["wall_seconds"] < 12 * 1.2
    assert last["wall_seconds"] > before["wall_seconds"] and last["level"] == 1.0
    assert run.read_options()["time_budget"] == "12s"


@pytest.mark.slow
@pytest.mark.alone
@pytest.mark.parametrize(
    "options",
    [{"schedule": "constant", "reset_every": 60}, {"schedule": "sig", "levels": (2.0, 1.0)}],
    ids=["constant", "sig"],
)
def test_a_budget_leaves_the_best_model(item_device, city, tmp_path, monkeypatch, options):
    """The last score is not below the one before but for noise; tests/training/test_budget.py cuts
    the time in many ways."""
    monkeypatch.setattr(budget, "REPORT_SECONDS", 0.2)
    run = trained(
        tmp_path / "run",
        city,
        item_device,
        **{
            "time_budget": "9s",
            "iterations": 30000,
            "downscale": 2.0,
            "densify_until": 0,
            "eval_every": "auto",
            "reset_every": 0,
            **options,
        },
    )
    scores = [record["psnr"] for record in records(run, "eval")]
    assert len(scores) >= 2 and scores[-1] > max(scores[:-1]) - 1
