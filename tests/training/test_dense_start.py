"""Whether a training begins at dense points, how many are wanted, and that it then does."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import clsplat.stereo.dense_points as dense_points_module
import clsplat.training.start.begin as start_module
from clsplat.errors import InputError
from clsplat.io.scenes.read import read_scene
from clsplat.options import resolve
from clsplat.stereo.dense_points import stereo_views
from clsplat.training.part import Survey
from clsplat.training.progress import SilentProgress
from clsplat.training.start import initialise
from clsplat.training.start.prepare import prepare
from tests.data.tiny_training import CITY, records, resumed, trained


@pytest.fixture(scope="module")
def city():
    return read_scene(CITY).reduced(4)


def start(scene, options):
    survey = Survey(scene, scene.views, options, None)
    return initialise.chosen_start(survey, lambda: stereo_views(scene, scene.views))


def chosen(scene, **options):
    return start(scene, resolve({}, {"iterations": 7000, **options}))


@pytest.mark.parametrize(
    "options, value",
    [
        ({}, "dense"),
        ({"schedule": "constant"}, "sfm"),
        ({"schedule": "mcmc"}, "sfm"),
        ({"preset": "paper"}, "sfm"),
        ({"preset": "release"}, "sfm"),
        ({"coarse": True}, "sfm"),
        ({"init": "sfm"}, "sfm"),
        ({"init": "random"}, "random"),
        ({"iterations": 32 * initialise.LEAST_STEPS}, "dense"),
        ({"iterations": 32 * initialise.LEAST_STEPS - 1}, "sfm"),
        ({"init": "dense", "schedule": "constant"}, "dense"),
        ({"init": "dense"}, "dense"),
    ],
    ids=str,
)
def test_sig_begins_at_dense_points_where_the_run_is_long_enough(city, options, value):
    found, reason = chosen(city, **options)
    assert found == value and reason.startswith(f"{value}: ")


@pytest.mark.parametrize(
    "seconds, value", [(32 * initialise.LEAST_SECONDS, "dense"), (32 * initialise.LEAST_SECONDS - 1, "sfm")]
)
def test_a_short_time_budget_begins_at_the_sparse_points(city, seconds, value):
    options = resolve({}, {"time_budget": f"{seconds:g}s", "iterations": 30_000})
    assert start(city, options)[0] == value


def test_photos_that_do_not_overlap(city):
    apart = replace(city, observations=city.observations[city.observations[:, 1] < 9])
    value, reason = chosen(apart)
    assert value == "sfm" and "only 9 of 32 photos" in reason
    assert chosen(apart, init="dense")[0] == "dense"
    nothing = replace(city, observations=city.observations[:0])
    with pytest.raises(InputError, match="city: --init dense needs three photos .* --init sfm"):
        chosen(nothing, init="dense")


@pytest.mark.slow
@pytest.mark.one_in(2)
def test_initial_gaussians_are_as_many_as_were_planned(city, float_device, monkeypatch):
    options = resolve({}, {"iterations": 700, "pixels_per_gaussian": 40.0})
    city = replace(city, views=city.views[8:18], observations=None)
    prepared = prepare(city, options, float_device)
    wanted = prepared.decisions.facts.count
    with monkeypatch.context() as patch:  # they are known by the decisions
        patch.delattr(dense_points_module, "stereo_views")
        gaussians, seconds, parts = initialise.first_gaussians(float_device, prepared, SilentProgress(), enter=False)
    assert parts == ()
    assert 0.5 * wanted < gaussians.count <= wanted < len(city.points) and seconds > 0
    assert 0 < initialise.start_seconds(float_device, prepared) < 60
    monkeypatch.setattr(
        initialise,
        "_dense",
        lambda *given: (
            SimpleNamespace(positions=city.points, colours=city.colours, sizes=np.ones(len(city.points))),
            1.0,
        ),
    )
    few = replace(options, max_gaussians=len(city.points) - 1, levels=(2.0, 1.0))
    with pytest.raises(InputError, match=f"--max-gaussians .* starts with {len(city.points)};"):
        initialise.first_gaussians(float_device, prepare(city, few), SilentProgress())
    middle, extent = city.points.mean(axis=0), np.ptp(city.points, axis=0)
    spread = gaussians.positions * prepared.scene.unit - middle
    assert (np.abs(spread) < 2 * extent).all()
    assert initialise.start_seconds(float_device, prepare(city, replace(options, init="sfm"))) == 0


def test_photos_are_read_during_the_search(city, item_device, tmp_path, monkeypatch):
    """Those of the first level and of the test views; no thread outlives a search that fails."""
    begun = []

    def noted(reads):
        def call(*given):
            begun.append(reads(*given))
            return begun[-1]

        return call

    def search(*given):
        for store in begun:
            store.wait()
        raise InputError("there are no points")

    for reads in (start_module.begin_checks, start_module.begin_photos):
        monkeypatch.setattr(start_module, reads.__name__, noted(reads))
    monkeypatch.setattr(start_module, "first_gaussians", search)
    with pytest.raises(InputError, match="there are no points"):
        trained(tmp_path / "run", city, item_device)
    assert len(begun) == 2 and all(store._threads._shutdown for store in begun)
    assert not list((tmp_path / "run").glob("*.json"))


@pytest.mark.slow
def test_a_training_begins_there_and_counts_the_time(city, item_device, tmp_path, monkeypatch):
    """The time of dense points is time of the training, also after it was resumed."""
    monkeypatch.setattr(
        start_module, "first_gaussians", lambda *given: initialise.first_gaussians(*given)._replace(seconds=1e3)
    )
    run = trained(
        tmp_path / "run",
        city,
        item_device,
        schedule="sig",
        iterations=32 * initialise.LEAST_STEPS,
        init="dense",
        stop_at=20,
        levels=(1.0,),
    )
    assert records(run, "plan")[0]["reasons"]["init"].startswith("dense: ")
    resumed(
        run,
        city,
        item_device,
        schedule="sig",
        iterations=32 * initialise.LEAST_STEPS,
        init="dense",
        stop_at=110,
        levels=(1.0,),
    )
    seconds = [record["train_seconds"] for record in records(run, "step")]
    assert len(seconds) > 1 and 1e3 < seconds[0] < seconds[-1] < 2e3
