"""Blocks that exchange gaussians: what they go on from, and that a kill changes nothing of it."""

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from clsplat.cities import block as training_block
from clsplat.cities import exchange
from clsplat.cities.block import block_options, train_block
from clsplat.cities.choose import Choice, block_start, choose_gaussians
from clsplat.cities.scene import BlockScene
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.io.models.ply import read_ply
from clsplat.io.npz import read_npz, state_array, write_npz
from clsplat.io.records import write_object
from clsplat.io.runs.city import BLOCK, EXCHANGES, OTHERS, BlockFolder, CityFolder
from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.read import fingerprint, read_scene
from clsplat.partition.region import Partition, Region, Space, world_of
from clsplat.training.checkpoint import Checkpoint
from tests.data.tiny_training import CITY, model_digest

OPTIONS = {
    "iterations": 130,
    "downscale": 8.0,
    "test_every": 0,
    "schedule": "constant",
    "sh_degree": 1,
    "sh_every": 1,
    "densify_from": 20,
    "densify_every": 40,
    "densify_until": 120,
    "reset_every": 0,
    "eval_every": 0,
    "exposure": "off",
    "checkpoint_every": 0,
}
AT = 100  # the exchange


@pytest.fixture(scope="module")
def stopped(tmp_path_factory, item_device):
    """A city of two blocks, both at their exchange: the first waits for the second."""
    scene = read_scene(CITY)
    world = scene.points + scene.offset
    space = Space(np.eye(3), world.mean(axis=0), np.ptp(world, axis=0) / 2)
    west, east = Region(space, margin=0.2).cut(0, 0.1)
    views = np.arange(0, 16, 2), np.arange(3, 16, 2)
    city = CityFolder(tmp_path_factory.mktemp("exchange") / "city")
    city.path.mkdir()
    city.write({"fingerprint": fingerprint(scene), "scene": str(scene.path)})
    city.write_partition(Partition("by hand", (west, east), views).record())
    first = Gaussians.from_points(scene.points, scene.colours, 1)
    for number, region in enumerate((west, east)):
        part = replace(scene, views=tuple(scene.views[i] for i in views[number]), observations=None).reduced(
            8.0, 10_000
        )
        start = block_start(
            first, choose_gaussians(item_device, first.positions, first.log_scales, scene, region, part.views)
        )
        city.write_block(
            number,
            scene,
            views[number],
            region,
            {},
            start.gaussians,
            None,
            OPTIONS,
            {**city.identity(), OTHERS: [1 - number], EXCHANGES: [AT]},
        )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training_block, "choose_device", lambda *_, **__: item_device)
        said = train_block(city.block(0))
        assert said.startswith("waits at exchange 1 of 1, after step 100: train 001 too")
        patch.setattr(training_block, "owned_at", lambda *_: pytest.exit("not yet"))
        patch.setattr(training_block, "lacking_blocks", lambda *_: ["000"])
        train_block(city.block(1))
    return city


def exchanged(block, own, others=None):
    """What a block owns at its exchange, and behind that what it holds of others; and the state."""
    others = exchange.other_blocks(block) if others is None else others
    arrays, state = exchange.owned_at(block, 1)
    beyond = exchange._beyond(
        training_block.choose_device(), exchange.BlockRun(block, own, 1, (arrays, state)), others, block_options(block)
    )
    return {**arrays, **{name: np.concatenate([arrays[name], rows]) for name, rows in beyond.items()}}, state


@pytest.fixture
def city(stopped, tmp_path, item_device, monkeypatch):
    monkeypatch.setattr(training_block, "choose_device", lambda *_, **__: item_device)
    monkeypatch.setattr("clsplat.report.run.drawn", lambda *_, **__: "")
    shutil.copytree(stopped.path, tmp_path / "city", symlinks=True)
    return CityFolder(tmp_path / "city")


@pytest.mark.slow
def test_a_block_goes_on_from_what_others_own(city):
    block, own = city.block(0), BlockScene.read(city.block(0))
    before = read_npz(block.exchanged(1))
    after, state = exchanged(block, own)
    assert not {"frozen.rows", "adam.last_step"} & set(before)
    assert set(after) == {*before, "frozen.rows", "adam.last_step"} - {"state.json"}
    scene = read_scene(block.path).reduced(8.0, 10_000).normalised()
    other = read_scene(city.block(1).path).normalised()
    part = read_npz(city.block(1).exchanged(1))
    count = len(before["row.positions"])
    assert own.region.owns(world_of(scene, before["row.positions"])).all()
    assert 0 < count and state["iteration"] == AT
    for name in ("row.positions", "row.sh_rest", "m.positions", "v.log_scales"):
        assert np.array_equal(after[name][:count], before[name]), name
    owned = world_of(other, part["row.positions"])
    taken = world_of(scene, after["row.positions"][count:])
    distance, row = cKDTree(owned).query(taken)
    assert distance.max() < 1e-5 * scene.unit and len(set(row)) == len(row)
    reached = own.region.reaches(owned)
    assert 50 < reached.sum() < len(owned) and np.isin(np.flatnonzero(reached), row).all()
    for name, power in (("m.positions", 1), ("v.positions", 2)):  # gradients by the same lengths
        assert np.allclose(after[name][count:] * (other.unit / scene.unit) ** power, part[name][row], rtol=1e-4), name
    assert not after["frozen.rows"].any() and (after["adam.last_step"] == AT).all()


def save(run, arrays, state):
    """Save as a training does that has these arrays."""
    rows = run.saved_rows(state["iteration"], lambda: arrays["row.positions"])
    run.save_checkpoint(
        arrays
        if rows is None
        else {name: values[rows] if exchange._is_by_gaussian(name) else values for name, values in arrays.items()},
        state,
    )


@pytest.mark.slow
def test_at_an_exchange_the_file_takes_the_place_of_the_checkpoint(city):
    block, own = city.block(0), BlockScene.read(city.block(0))
    before, file = read_npz(block.exchanged(1)), block.run / "checkpoint.npz"
    arrays, state = exchanged(block, own)
    for number, step in ((1, AT - 1), (0, AT)):  # before it, and to the end
        run = exchange.BlockRun(block, own, number)
        save(run, arrays, {**state, "iteration": step})
        assert run.checkpoint_iteration() == step and file.exists()
    average = {"average.samples": np.array(1)}  # of rows that go
    save(exchange.BlockRun(block, own, 1), {**arrays, **average}, state)
    assert not file.exists()
    after = read_npz(block.exchanged(1))
    assert set(after) == set(before)
    assert all(np.array_equal(after[name], values) for name, values in before.items() if name != "state.json")
    run = exchange.BlockRun(block, own, 0, (arrays, state))
    assert len(run.owned) == len(arrays["row.positions"]) and not len(run.none["m.positions"])
    assert run.has_checkpoint and run.load_checkpoint()[0] is arrays and not run.has_checkpoint


def test_rows_of_several_blocks_are_held_in_their_order(monkeypatch):
    """Of four others: the first is held as a whole, the third is far away, the last not held."""
    rng = np.random.default_rng(0)

    def rows(count):
        found = {
            f"{kind}.{name}": rng.random((count, 3)).astype(np.float32)
            for kind in exchange.BY_GAUSSIAN
            for name in ("positions", "log_scales")
        }
        return {**found, "statistics.seen_count": np.arange(count, dtype=np.uint32)}

    none, others, read = rows(0), [rows(2), rows(5), rows(3), rows(2)], []
    indices, reached = np.array([0, 1, 3, 5, 6, 8, 9]), np.array([0, 1, 0, 0, 1, 0, 0], bool)
    scales = rng.random((7, 3)).astype(np.float32)

    def owned(number, _, record, wanted, rows=slice(None)):
        read.append((number, *wanted))
        return {
            name: values[rows]
            for name, values in others[number].items()
            if name in (*wanted, "statistics.seen_count") or name.partition(".")[0] in wanted
        }, None

    def choose(_, positions, log_scales, *__):
        assert np.array_equal(positions, np.concatenate([o["row.positions"] for o in others]))
        assert np.array_equal(log_scales, np.concatenate([o["row.log_scales"] for o in others]))
        return Choice(indices, scales, reached, reached)

    monkeypatch.setattr(exchange, "_owned", owned)
    monkeypatch.setattr(exchange, "_in_frame_of", lambda scene, arrays, frame: arrays)
    monkeypatch.setattr(exchange, "choose_gaussians", choose)
    found = exchange._of_others(None, none, [0, 1, 2, 3], 1, {}, SimpleNamespace(views=()), None)
    assert set(found) == set(none)
    for name in none:
        taken = np.concatenate([other[name] for other in others])[indices]
        if name == "row.log_scales":
            taken = scales
        elif name.startswith(("m.", "v.")):
            taken[5:] = 0  # nothing of the last one is trained
        assert np.array_equal(found[name], taken), name
    assert (2, "row") in read and not {(2, "m"), (2, "v"), (3, "row")} & set(read)


@pytest.mark.slow
def test_far_from_a_block_no_moments_are_read(city):
    block, own = city.block(0), BlockScene.read(city.block(0))
    near, _ = exchanged(block, own)
    far = replace(own, region=replace(own.region, margin=0.0))
    after, _ = exchanged(block, far)
    count = len(read_npz(block.exchanged(1))["row.positions"])
    assert near["m.positions"][count:].any() and near["v.sh_rest"][count:].any()
    for name in ("m.positions", "v.sh_rest"):
        assert after[name].dtype == near[name].dtype and not after[name][count:].any()


@pytest.mark.slow
def test_a_block_that_goes_on_alone_has_again_the_margin_with_which_it_began(city):
    block, own = city.block(0), BlockScene.read(city.block(0))
    after, _ = exchanged(block, own, [])
    before, start = read_npz(block.exchanged(1)), read_ply(block.initial, own.scene.offset)
    count, beyond = len(before["row.positions"]), ~own.region.owns(world_of(own.scene, start.positions))
    assert np.array_equal(after["row.positions"][:count], before["row.positions"])
    scene = own.scene.reduced(8.0, 10_000).normalised()
    assert np.allclose(
        world_of(scene, after["row.positions"][count:]), world_of(own.scene, start.positions[beyond]), atol=1e-5
    )
    assert not after["m.positions"][count:].any() and after["m.positions"][:count].any()
    assert train_block(block, alone=True) == "finished"


@pytest.mark.slow
def test_a_kill_during_an_exchange_changes_nothing(city, monkeypatch):
    block, copy = city.block(0), CityFolder(city.path.with_name("copy"))
    shutil.copytree(city.path, copy.path, symlinks=True)
    assert train_block(block) == "finished"
    killed = copy.block(0)

    def dies(*_, **__):
        raise SystemExit(9)

    # in the exchange, after it, and where the training ends that follows it
    for owner, name in (
        (exchange, "choose_gaussians"),
        (training_block, "training_of"),
        (Checkpoint, "check_model"),
        (RunFolder, "save_model"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, dies)
            with pytest.raises(SystemExit):
                train_block(killed)
    assert train_block(killed) == "finished"
    assert model_digest(RunFolder(killed.run)) == model_digest(RunFolder(block.run))
    assert train_block(killed) == "was finished before"


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["coded", "auto", "numpy"])
@pytest.mark.one_in(3)
def test_a_training_that_rests_goes_on_to_the_same_bytes(city, item_device, engine):
    """The exchange in place, and from files; the block is cut anew with this engine."""
    for number in (0, 1):
        record = json.loads((city.block(number).path / BLOCK).read_text())
        record["options"]["engine"] = engine
        write_object(city.block(number).path / BLOCK, record)
        shutil.rmtree(city.block(number).run)
        said = train_block(city.block(number), item_device, until=1, rests=True)
        assert said.startswith("stops at exchange 1 of 1")
    assert [begun.run.path for begun in training_block._resting] == [city.block(1).run]
    copy = CityFolder(city.path.with_name("copy"))
    shutil.copytree(city.path, copy.path, symlinks=True)
    begun, others = training_block._resting[0], exchange.other_blocks(city.block(1))
    exchange.exchange(begun.training, begun.run, others, block_options(city.block(1)))
    expected, model = exchanged(city.block(1), begun.run.own)[0], begun.training.session.model
    moments = dict(zip("mv", model.adam.download()))
    begun.run.owned = np.arange(len(begun.run.owned))  # which come first now
    for kind, field in (("m", "positions"), ("v", "sh_rest")):  # of rows of others, too
        name = f"{kind}.{field}"
        assert expected[name][len(begun.run.owned) :].any()
        rounding = 0.1 if engine == "coded" else 1e-6
        assert np.allclose(
            moments[kind][field], expected[name], rtol=rounding, atol=rounding * 1e-2 * abs(expected[name]).max()
        ), name
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training_block, "owned_at", lambda *_: pytest.fail("read from files"))
        assert train_block(city.block(1), item_device, rests=True) == "finished"
    assert not training_block._resting
    assert train_block(copy.block(1), item_device) == "finished"
    assert model_digest(RunFolder(city.block(1).run)) == model_digest(RunFolder(copy.block(1).run))


@pytest.mark.slow
def test_a_block_that_owns_nothing_goes_on_with_what_others_own(city):
    block, own = city.block(0), BlockScene.read(city.block(0))
    arrays, state = exchanged(block, own)
    arrays["row.positions"] += 1e4
    save(exchange.BlockRun(block, own, 1), arrays, state)
    assert len(read_npz(block.exchanged(1))["row.positions"]) == 1
    assert train_block(block) == "finished"


@pytest.mark.slow
def test_a_block_stops_where_it_is_told_to_though_others_have_come_as_far(city):
    block = city.block(0)
    run, part = RunFolder(block.run), block.exchanged(1)
    content = read_npz(part)
    part.unlink()
    said = train_block(block, until=1)
    assert said == f"stops at exchange 1 of 1, after step {AT}"
    assert not run.has_checkpoint and not run.has_model
    again = read_npz(part)
    assert all(
        np.array_equal(again[name], values) for name, values in content.items() if name != "state.json"
    )  # which has seconds
    assert train_block(block) == "finished"


def test_files_of_an_exchange_go_once_all_blocks_have_come_to_the_next(tmp_path):
    blocks = [BlockFolder(tmp_path / f"00{n}") for n in range(3)]

    def left(*come_to):
        for block, number in zip(blocks, come_to):
            block.run.mkdir(parents=True, exist_ok=True)
            if number:
                block.exchanged(number).touch()
        exchange.remove_passed(blocks)
        return [block.exchanges_there() for block in blocks]

    assert left(1, 1, 0) == [[1], [1], []]
    assert left(2, 0, 1) == [[1, 2], [1], [1]]
    assert left(0, 2, 2) == [[2], [2], [2]]
    (blocks[0].run / "point_cloud.ply").touch()  # finished, and needs none, but others need its own
    assert left(0, 3, 0) == [[2], [2, 3], [2]]
    assert left(0, 0, 3) == [[2], [3], [3]]
    assert exchange.lacking_blocks(blocks, 3) == ["000"]
    assert exchange.lacking_blocks(blocks[1:], 1) == []
    job = training_block.BlockJob("a", blocks[1].run, block=blocks[1], until=2)
    assert job.is_done and not replace(job, until=3).is_done and not replace(job, until=0).is_done


@pytest.mark.slow
def test_a_block_that_is_trained_again_takes_what_others_own_later(city):
    block, other = city.block(0), city.block(1)
    first = read_npz(other.exchanged(1))
    assert train_block(block) == "finished"
    shutil.rmtree(block.run)
    other.exchanged(1).rename(other.exchanged(2))
    assert train_block(block) == "finished"
    assert block.exchanges_there() == [1] and other.exchanges_there() == [2]
    model = RunFolder(block.run).load_model()
    assert len(model.positions) > len(first["row.positions"])


@pytest.mark.slow
def test_parts_that_cannot_be_used_are_named(city):
    block, other = city.block(0), city.block(1)
    content = other.exchanged(1).read_bytes()
    arrays = read_npz(other.exchanged(1))
    places = content.index(arrays["row.positions"].tobytes())
    arrays["m.positions"][:] = np.nan
    with open(other.exchanged(1).with_suffix(".nan"), "wb") as file:
        write_npz(file, arrays)
    for damaged in (
        content[:-300],
        other.exchanged(1).with_suffix(".nan").read_bytes(),
        content[:places] + b"?" + content[places + 1 :],
    ):
        other.exchanged(1).write_bytes(damaged)
        with pytest.raises(InputError, match=r"exchange_1.npz: not .*damaged .* train that block"):
            exchanged(block, BlockScene.read(block))
    arrays = read_npz(block.exchanged(1))
    state = json.loads(arrays["state.json"].tobytes())
    assert state["format"] == 1
    with open(other.exchanged(1), "wb") as file:
        write_npz(file, {**arrays, "state.json": state_array({**state, "format": 2})})
    with pytest.raises(InputError, match=r"exchange_1.npz: has format 2, .* newer clsplat"):
        exchanged(block, BlockScene.read(block))
    record = json.loads((other.path / BLOCK).read_text())
    (other.path / BLOCK).write_text(json.dumps({**record, "partition": "another"}))
    with pytest.raises(InputError, match="a block of another partition"):
        exchange.lacking_blocks(exchange.other_blocks(block), 1)
    shutil.rmtree(other.path)
    assert exchange.lacking_blocks(exchange.other_blocks(block), 1) == ["001"]
    shutil.move(block.path, city.path.parent / "far" / "away" / "000")
    with pytest.raises(InputError, match="with --alone"):
        exchange.other_blocks(type(block)(city.path.parent / "far" / "away" / "000"))


def test_exchanges_lie_in_the_second_half():
    assert exchange.exchange_steps(7000, 3) == [3500, 4700, 5800]
    for steps in (200, 399, 1000, 1234, 30_000):
        for count in range(1, min(9, exchange.most_exchanges(steps)) + 1):
            found = exchange.exchange_steps(steps, count)
            assert len({*found}) == count and found == sorted(found)
            assert found[0] >= 100 and found[-1] < steps and not any(step % 100 for step in found)
