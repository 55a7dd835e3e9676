"""What a round of growth makes of the gaussians by the rule of each schedule."""

import importlib
from pathlib import Path

import numpy as np
import pytest

import clsplat
from clsplat.densify.round import Round
from clsplat.options import TrainOptions, resolve
from clsplat.schedule.dash import Dash
from clsplat.schedule.mcmc import Mcmc
from clsplat.schedule.plan import SceneFacts, Schedule
from clsplat.schedule.taming import Taming
from tests.data.tiny_training import CITY

COUNT = 6
GRADIENT = np.array([3e-4, 1e-4, 2e-4, 9e-4, 0.0, 5e-4])
SCORES = np.array([1.0, 9.0, 0.0, 2.0, 3.0, 4.0])
FACTS = SceneFacts((640, 480), COUNT, 1.0, photos=None, pixels=1)
EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"


def with_target(base, most=None):
    """A schedule of a kind whose target is given; another package may have none."""

    class Other(base):
        def __init__(self):
            Schedule.__init__(self, TrainOptions(), FACTS)

        def target(self, iteration, count, above):
            return most

    return Other()


def a_round(frozen=(), transparent=(), iteration=501, count=COUNT, **options):
    """A round of small gaussians, of which none is split."""
    rng = np.random.default_rng(0)
    rows = {
        "positions": rng.normal(size=(count, 3)),
        "log_scales": np.full((count, 3), -9.0),
        "opacity_logits": np.where(np.isin(np.arange(count), transparent), -9.0, 2.0),
        "quaternions": rng.normal(size=(count, 4)),
    }
    options = resolve({}, {"schedule": "constant", **options})
    rows = {name: values.astype(np.float32) for name, values in rows.items()}
    return Round(
        iteration,
        rows,
        1.0,
        options,
        False,
        np.isin(np.arange(count), frozen),
        lambda: GRADIENT[:count],
        lambda gradient: SCORES,
        lambda: SCORES,
    )


def clones(growth):
    """The sources of the clones, where all gaussians stay."""
    assert growth.kept == COUNT and growth.source[:COUNT].tolist() == list(range(COUNT))
    return growth.source[COUNT:].tolist()


def test_without_a_target_all_that_reach_the_threshold_grow():
    schedule = with_target(Schedule)
    assert clones(schedule.grow(a_round())) == [0, 2, 3, 5]
    assert clones(schedule.grow(a_round(frozen=(3, 4)))) == [0, 2, 5]
    assert clones(schedule.grow(a_round(max_gaussians=7))) == [3]
    assert clones(schedule.grow(a_round(frozen=(0, 1), max_gaussians=7))) == [3]


@pytest.mark.parametrize(
    "base, most, chosen",
    [
        (Schedule, 8, [3, 5]),
        (Schedule, 20, [0, 2, 3, 5]),
        (Dash, 8, [3, 5]),
        (Dash, 20, [0, 1, 2, 3, 5]),
        (Schedule, 3, []),
        (Dash, 3, []),
    ],
)
def test_a_target_limits_the_round(base, most, chosen):
    assert clones(with_target(base, most).grow(a_round())) == chosen


def test_taming_draws_those_above_the_threshold_that_have_a_score():
    schedule = with_target(Taming, 20)
    schedule.options = resolve({}, {"schedule": "taming", "densify_from": 0, "densify_every": 100})
    assert clones(schedule.grow(a_round())) == [0, 3, 5]
    transparent = (0, 1, 2, 4)
    early, late = (schedule.grow(a_round(transparent=transparent, iteration=iteration)) for iteration in (501, 4001))
    assert (early.pruned, late.pruned) == (2, 4)  # at first half of them stay


def test_mcmc_needs_no_gradient_and_moves_the_transparent():
    schedule, measured = with_target(Mcmc, 8), a_round(transparent=(1,))
    measured._gradient = None
    growth = schedule.grow(measured)
    assert (len(growth.source), growth.cloned, growth.pruned) == (8, 3, 1)


@pytest.fixture
def random_growth(monkeypatch):
    """The schedule of docs/examples/random_growth.py."""
    monkeypatch.syspath_prepend(EXAMPLES)
    assert (EXAMPLES / "random_growth.py").is_file()
    return importlib.import_module("random_growth").RandomGrowth


def test_a_rule_of_another_package_takes_half_of_those_above_the_threshold(random_growth):
    schedule = random_growth(resolve({}, {"schedule": "constant"}), FACTS)
    chosen = [clones(schedule.grow(a_round(iteration=iteration))) for iteration in range(1, 200)]
    assert set(sum(chosen, [])) == {0, 2, 3, 5}
    assert np.mean([len(each) for each in chosen]) == pytest.approx(2, abs=0.2)


@pytest.mark.slow
def test_a_training_grows_by_the_rule_of_another_package(random_growth, item_device):
    options = clsplat.TrainOptions(
        iterations=40,
        downscale=8,
        exposure="off",
        densify_from=0,
        densify_every=10,
        densify_until=30,
        grow_threshold=2e-5,
    )
    run = clsplat.train(clsplat.Scene.read(CITY), options, schedule=random_growth, device=item_device)
    grown = [record for record in run.metrics if record["event"] == "grow"]
    assert len(grown) == 2 and all(record["cloned"] + record["split"] for record in grown)
