"""The joint training of a merged city: when there is one, with what it begins, and what it ends in."""

import shutil
import signal
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from clsplat.cities import merge as merging
from clsplat.cities.city import City, train_coarse
from clsplat.cities.cut import JOINT, requested_of
from clsplat.cities.merge import Merged, begin_with, joint_options, merged_city, train_jointly
from clsplat.cities.run import chosen_partition
from clsplat.device import choose_device
from clsplat.errors import DeviceError, InputError, Interrupted, OutOfDeviceMemory
from clsplat.io.models.ply import read_ply, write_ply
from clsplat.io.runs.city import CityFolder
from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.read import fingerprint, read_scene
from clsplat.options import resolve
from clsplat.training.interrupt import handled_interrupts
from clsplat.training.run import train
from tests.city.test_city import DEVICE, a_card, city, model
from tests.city.test_merge import strewn
from tests.data.tiny_training import CITY

LARGE, SMALL = a_card(2**36), a_card(2**20)


@cache
def sample():
    return read_scene(CITY)


def steps(folder, device=LARGE, given=(), tree=False, **options):
    """(Joint steps, exchanges, block steps) of a city in 2x1 blocks."""
    whole = City(CityFolder(folder), sample(), resolve({}, options), device)
    chosen = chosen_partition({"grid": (2, 1), **dict(given)}, whole, tree=tree)
    return chosen.joint_steps, chosen.exchanges, chosen.block_steps


def test_a_city_that_a_device_holds_is_trained_jointly(tmp_path):
    assert steps(tmp_path) == (0.5, 0, 0.25)
    apart = (0.0, 3, 2.0)
    assert steps(tmp_path, SMALL) == apart, "the device does not hold it"
    assert steps(tmp_path, given={"grid": (1, 1)}) == apart, "one block"
    assert steps(tmp_path, tree=True) == apart, "a tree is made block by block"
    assert steps(tmp_path, schedule="constant") == apart, "trained as published"
    assert steps(tmp_path, time_budget="5m") == apart
    assert steps(tmp_path, iterations=6900) == apart, "more steps are worthwhile"
    assert steps(tmp_path, visits=0.0) == apart, "any number of steps is"
    assert steps(tmp_path, visits=31.0) == apart, "28 photos, 868 steps: a short training"
    assert steps(tmp_path, visits=33.0) == steps(tmp_path)


def test_what_the_user_says_holds(tmp_path):
    assert steps(tmp_path, given={"joint_steps": 0.0}) == (0.0, 3, 2.0)
    assert steps(tmp_path, SMALL, {"joint_steps": 0.3}) == (0.3, 0, 0.25)
    assert steps(tmp_path, given={"exchanges": 2, "block_steps": 3.0})[1:] == (2, 3.0)


@pytest.mark.parametrize(
    "recorded",
    [
        {"exchanges": 3, "block_steps": 2.0},  # of a version without joint training
        {"joint_steps": 0.5, "exchanges": 0, "block_steps": 1.0},
    ],
)
def test_a_city_keeps_the_steps_with_which_it_was_cut(tmp_path, recorded):
    CityFolder(tmp_path).write_partition({"asked": recorded})
    wanted = tuple({"joint_steps": 0.0, **recorded}[name] for name in ("joint_steps", "exchanges", "block_steps"))
    assert steps(tmp_path) == steps(tmp_path, SMALL) == wanted


@pytest.fixture
def folder(tmp_path):
    folder = CityFolder(tmp_path)
    folder.write_partition({})
    return folder


def whole_of(folder, **options):
    return City(folder, read_scene(CITY), resolve({}, options), None)


@pytest.fixture
def merged():
    return strewn(9)


def test_a_joint_training_of_another_model_is_removed(folder, merged):
    whole, kept = whole_of(folder), folder.joint / "kept"
    begin_with(whole, merged)
    folder.joint.mkdir()
    kept.touch()
    begin_with(whole, merged)
    assert kept.exists(), "the same model"
    merged.rows["positions"][0] += 1
    begin_with(whole, merged)
    assert not kept.exists()
    assert sorted(path.name for path in folder.path.iterdir()) == ["joint_start.ply", "partition.json"]


def test_it_begins_at_the_points_of_the_merged_model(folder):
    """With their colours, but not with their shapes, opacities and directions of light."""
    model, scene = strewn(200), read_scene(CITY)
    model.rows["sh_constant"][:] = np.linspace(-1, 1, 600).reshape(200, 3)
    begin_with(whole_of(folder), model)
    start = read_ply(folder.joint_start, scene.offset)
    assert start.sh_degree == 0 and np.allclose(start.positions, model.positions)
    assert abs(start.sh_constant - model.sh_constant).max() <= 0.5 / 255 / 0.282 + 1e-6
    assert np.allclose(start.opacity_logits, np.log(0.1 / 0.9))
    assert (start.log_scales == start.log_scales[:, :1]).all()


def test_half_of_the_points_are_dense_ones(folder):
    """Where the city has such; with another seed they are others."""
    model, scene = strewn(2000), read_scene(CITY)
    dense = strewn(1000)
    dense.rows["positions"][:] += 1000
    dense.rows["sh_constant"][:] = 0.25
    write_ply(folder.dense, dense.with_sh_degree(0), scene.offset)
    begin_with(whole_of(folder), model)
    start = read_ply(folder.joint_start, scene.offset)
    of_dense = start.positions[:, 0] > 500
    for part, of_part in ((dense, of_dense), (model, ~of_dense)):
        assert abs(of_part.sum() / part.count - 0.5) < 0.05
        known = set(map(tuple, part.positions.round(2).tolist()))
        assert known.issuperset(map(tuple, start.positions[of_part].round(2).tolist()))
    assert abs(start.sh_constant[of_dense] - 0.25).max() <= 0.5 / 255 / 0.282 + 1e-6
    before = folder.joint_start.read_bytes()
    begin_with(whole_of(folder), model)
    assert folder.joint_start.read_bytes() == before
    begin_with(whole_of(folder, seed=1), model)
    assert folder.joint_start.read_bytes() != before


def test_a_limit_of_gaussians_is_one_of_each_block(folder, merged):
    def most(limit):
        return joint_options(whole_of(folder), {"max_gaussians": limit}, merged.count).max_gaussians

    assert (most(0), most(5), most(20)) == (0, 9, 20)


@pytest.mark.parametrize("given, cause", [({"iterations": "many"}, "iterations"), ({"nothing": 1}, "nothing")])
def test_damaged_options_are_named(folder, given, cause):
    with pytest.raises(InputError, match=f"partition.json: .*{cause}"):
        joint_options(whole_of(folder), given, 9)


def test_options_that_are_no_table_are_named(folder, merged):
    folder.write_partition({"asked": [1], JOINT: "many"})
    for key, read in (
        ("asked", lambda: requested_of(folder)),
        (JOINT, lambda: train_jointly(whole_of(folder), merged)),
    ):
        with pytest.raises(InputError, match=rf"partition.json: damaged \({key} is .*; remove it"):
            read()


@pytest.mark.parametrize("error", [OutOfDeviceMemory, DeviceError])
def test_a_device_that_cannot_hold_the_whole_leaves_it_as_merged(folder, merged, monkeypatch, caplog, error):
    def fails(*_):
        raise error("a card: no memory")

    blocks = Merged(merged, (), {}, folder.path)
    for name, value in (("merge", lambda *_: blocks), ("train_jointly", fails), ("_note_merge", lambda *_: None)):
        monkeypatch.setattr(merging, name, value)
    if error is DeviceError:
        with pytest.raises(error):
            merged_city(whole_of(folder))
        return
    assert merged_city(whole_of(folder)) is blocks
    assert "no joint training" in caplog.text


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    return city(tmp_path_factory.mktemp("joint") / "city", "--joint-steps", "0.5", "--workers", "2")


@pytest.mark.nightly
def test_the_model_of_a_city_is_that_of_the_joint_training(trained):
    run, joint = RunFolder(trained.path), RunFolder(trained.joint)
    offset, scene, record = np.array(run.read_options()["offset"]), read_scene(CITY), (joint.read_options())
    assert record["iterations"] == 30 and joint.is_finished
    # it has the scene of one run: the same extent, and the same views held out
    assert record["test_every"] == trained.read()["options"]["test_every"] == 8
    assert record["fingerprint"] == fingerprint(scene)
    assert record["extent"] == pytest.approx(scene.extent)
    assert not (trained.joint / "report.html").exists()
    whole, end = run.load_model(offset), joint.load_model(offset)
    assert whole.count == end.count
    assert np.array_equal(np.sort(whole.positions, axis=0), np.sort(end.positions, axis=0))
    owner = trained.partition().owner(whole.positions.astype(float) + offset)
    shares = merging.merge_record(trained)["blocks"]
    assert owner.tolist() == [0] * shares[0]["gaussians"] + [1] * shares[1]["gaussians"]
    assert not np.array_equal(read_ply(trained.joint_start, offset).positions, whole.positions)
    parts = [
        RunFolder.open(path).records()[-1]
        for path in (trained.coarse, *(block.run for block in trained.blocks()), trained.joint)
    ]
    scores = [record for record in run.records() if record["event"] == "eval"][-1]
    assert scores["iteration"] == sum(part["iteration"] for part in parts)
    assert scores["gaussians"] == joint.load_model(offset).count
    assert trained.read_partition()["asked"]["exchanges"] == 0
    page = (run.path / "report.html").read_text()
    assert "as a whole for 30 steps" in page
    assert "overlap" not in page  # the blocks' own gaussians are not shown
    assert not any(
        record["event"] == "eval" for part in (trained.coarse, trained.joint) for record in RunFolder(part).records()
    )


@pytest.mark.nightly
def test_a_stopped_joint_training_goes_on(trained, tmp_path, monkeypatch):
    shutil.copytree(trained.path, tmp_path / "city", symlinks=True)
    copy = CityFolder(tmp_path / "city")
    before = model(copy)
    (copy.path / "point_cloud.ply").unlink()
    shutil.rmtree(copy.joint)
    partition = copy.read_partition()
    given = dict(partition[JOINT])
    scene, options = read_scene(CITY), resolve({}, {**copy.read()["options"]})
    device = choose_device(DEVICE, form="item")
    copy.write_partition({**partition, JOINT: {**given, "stop_at": 11}})
    monkeypatch.setattr(CityFolder, "identity", lambda _: trained_identity)
    trained_identity = {key: copy.blocks()[0].read()[key] for key in ("city", "partition")}
    with pytest.raises(Interrupted):
        merged_city(City(copy, scene, options, device))
    assert RunFolder(copy.joint).checkpoint_iteration() == 11 and not RunFolder(copy.path).has_model
    copy.write_partition(partition)
    merged_city(City(copy, scene, options, device))
    assert model(copy) == before


def test_a_coarse_run_goes_on_with_the_steps_with_which_it_began(tmp_path, item_device):
    """On another device the city may have no joint training, and other steps."""
    folder, scene = CityFolder(tmp_path), read_scene(CITY)
    options = resolve({}, {"iterations": 24, "downscale": 8.0, "sh_degree": 0, "exposure": "off", "init": "sfm"})
    with pytest.raises(Interrupted):
        train_coarse(City(folder, scene, replace(options, stop_at=4), item_device), joint=True)
    run = train_coarse(City(folder, scene, options, item_device))
    assert run.records()[-1]["iteration"] == 6


def test_an_interrupt_in_the_last_step_of_a_part_stops_the_city(tmp_path, item_device):
    """The part is finished, but the city must not go on to the next one."""

    def press(record):
        if record["event"] == "end":
            signal.raise_signal(signal.SIGINT)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # jobs of a shell ignore it
    options = resolve(
        {}, {"iterations": 4, "downscale": 8.0, "sh_degree": 0, "exposure": "off", "init": "sfm", "coarse": True}
    )
    run = RunFolder.create(tmp_path / "coarse")
    try:
        with handled_interrupts(), pytest.raises(Interrupted):
            train(read_scene(CITY), options, item_device, run, callbacks=[press])
    finally:
        signal.signal(signal.SIGINT, before)
    assert run.is_finished
