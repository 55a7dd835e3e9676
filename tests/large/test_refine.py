"""The second round of a city: blocks under their neighbours' finished models."""

import shutil
from types import SimpleNamespace

import numpy as np
import pytest

from clsplat.city import stages
from clsplat.city.refine import refining_options
from clsplat.gaussians import LEARNED, Gaussians
from clsplat.io.city import CityFolder
from clsplat.io.ply import read_ply
from clsplat.io.run import RunFolder
from clsplat.options import TrainOptions, resolve
from clsplat.region import Region, Space
from clsplat.schedule import SCHEDULES, scaled_steps
from tests.large.test_city import city as first_round
from tests.large.test_city import command, model

FLAGS = ("--refine", "0.5")


def city(folder, *flags, code=0):
    return first_round(folder, *FLAGS, *flags, code=code)


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    return first_round(tmp_path_factory.mktemp("first") / "city")


@pytest.fixture(scope="module")
def made(first, tmp_path_factory):
    """A city whose second round was asked for later."""
    folder = tmp_path_factory.mktemp("refined") / "city"
    shutil.copytree(first.path, folder, symlinks=True)
    return city(folder)


@pytest.fixture
def copy(made, tmp_path):
    shutil.copytree(made.path, tmp_path / "city", symlinks=True)
    return CityFolder(tmp_path / "city")


def psnr(folder):
    return [r for r in RunFolder.open(folder.path).records() if r["event"] == "eval"][-1]["psnr"]


def test_the_second_round_goes_on_from_the_merged_model(first, made):
    assert model(made) != model(first) and psnr(made) > psnr(first)
    scaffold = read_ply(made.refined.coarse / "point_cloud.ply").positions
    assert np.array_equal(scaffold, read_ply(first.path / "point_cloud.ply").positions)
    assert len(made.refined.blocks()) == len(made.blocks()) == 2
    for again, block in zip(made.refined.blocks(), made.blocks()):
        before, options = block.read(), again.read()["options"]
        assert options["iterations"] == round(0.5 * 60 * before["views"] / 28)
        assert options["exposure"] == before["options"]["exposure"]
        begun = {tuple(row) for row in read_ply(again.initial).positions}
        assert begun & {tuple(row) for row in scaffold}
        grown = [r for r in RunFolder.open(again.run).records() if r["event"] == "grow"]
        assert not grown and RunFolder.open(again.run).load_model().count == len(begun)
    merged = RunFolder.open(made.path)
    assert merged.load_model().count == pytest.approx(len(scaffold), rel=0.02)  # some change sides
    spent = [record for record in merged.records() if record["event"] == "eval"][-1]["iteration"]
    runs = [made.coarse, *(b.run for b in (*made.blocks(), *made.refined.blocks()))]
    assert len(runs) == 5
    assert spent == sum(RunFolder.open(run).records()[-1]["iteration"] for run in runs)


def test_again_changes_nothing(copy, monkeypatch):
    before = model(copy)
    monkeypatch.setattr(stages, "train", None)  # nothing is begun
    city(copy.path)
    assert model(copy) == before


def test_without_it_the_first_round_is_merged(copy, first):
    first_round(copy.path)
    assert model(copy) == model(first)


@pytest.mark.slow
def test_it_goes_on_where_it_was_and_stages_one_by_one_end_in_the_same(first, copy):
    before = model(copy)
    shutil.rmtree(copy.refined.block(1).run)
    (copy.refined.path / "partition.json").unlink()  # as a kill leaves it before its last file
    shutil.rmtree(copy.refined.block(0).path)
    city(copy.path)
    assert model(copy) == before
    shutil.rmtree(copy.path)
    shutil.copytree(first.path, copy.path, symlinks=True)
    command("refine", copy.path, "--share", "0.5")
    command("merge", copy.path, code=2)  # not the first round's by mistake
    for block in copy.refined.blocks():
        command("block", block.path, "-q")
    command("merge", copy.path, "--device", "Portable")
    assert model(copy) == before


def test_what_is_lacking_is_named(copy, capsys):
    shutil.rmtree(copy.refined.block(1).run)
    command("merge", copy.path, code=2)
    error = capsys.readouterr().err
    assert "refined: 1 of 2 blocks cannot be merged: 001 unfinished" in error
    command("merge", copy.path, "--fill", "--device", "Portable")
    command("refine", copy.path, "--share", "0.7", code=2)
    assert "was begun with iterations 30" in capsys.readouterr().err
    shutil.rmtree(copy.refined.path)
    shutil.rmtree(copy.block(0).run)
    command("refine", copy.path, code=2)
    assert "city: 1 of 2 blocks cannot be merged: 000 unfinished" in capsys.readouterr().err
    assert not copy.refined.path.exists()


def test_a_block_of_the_first_round_is_none_of_the_second(copy, capsys):
    shutil.rmtree(copy.refined.block(0).path)
    shutil.copytree(copy.block(0).path, copy.refined.block(0).path, symlinks=True)
    command("merge", copy.path, code=2)
    assert "a block of another partition" in capsys.readouterr().err


@pytest.mark.parametrize("schedule", ["sig", "constant", "dash", "taming"])
def test_nothing_grows_or_is_reset_whatever_the_schedule(schedule):
    given = {"schedule": schedule, "iterations": 4000, "max_gaussians": 9, "ssim_weight": 0.4}
    given.update({"sphere_reach": 3.0, "level_share": 0.5} if schedule == "sig" else {})
    options = refining_options(resolve({}, given), 0.25)
    assert options == resolve({}, vars(options))  # one that a command line could give
    assert (options.iterations, options.max_gaussians, options.ssim_weight) == (1000, 0, 0.4)
    schedule = SCHEDULES[options.schedule](scaled_steps(options), None)
    plans = [schedule.plan(iteration) for iteration in range(1, 1001)]
    assert not any(plan.grows or plan.resets_opacity for plan in plans)
    assert {plan.level for plan in plans} == {1}


def test_a_budget_of_time_is_shared():
    options = refining_options(resolve({}, {"time_budget": "2m"}), 0.25)
    assert options.time_budget == "30" and options.iterations == TrainOptions.iterations


def test_what_is_far_from_a_block_is_the_coarse_models():
    """Else a block of a large city would begin with all that its photos show, finished."""
    rng, space = np.random.default_rng(0), Space(np.eye(3), np.zeros(3), np.full(3, 10.0))
    region = Region(space, (-1, -1, -np.inf), (-0.5, -0.5, np.inf), margin=0.1)
    scene = SimpleNamespace(offset=np.array([3.0, 0, 0]), unit=2.0)
    near, far = (Gaussians({field.name: rng.uniform(-6, 6, (500, *field.row_shape(1))).astype(
        np.float32) for field in LEARNED}, 1) for _ in range(2))
    mixed = stages.near_and_far(near, far, scene, region)
    # a side is 5 world units: the reach ends 0.5 beyond the cell's -5, the ring 1.0 after that
    x, y = (3 + 2 * mixed.positions[:, 0], 2 * mixed.positions[:, 1])
    inside = (x < -3.5) & (y < -3.5) & (x >= -11.5) & (y >= -11.5)
    assert 20 < inside.sum() < 480
    for name, rows in mixed.rows.items():
        given = {tuple(np.ravel(row)) for row in near.rows[name]}
        assert [tuple(np.ravel(row)) in given for row in rows] == inside.tolist(), name
