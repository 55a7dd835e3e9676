"""A block trains its part of a scene, and ends in the same bytes however often it is stopped."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from clsplat.cities import block as training_block
from clsplat.cities.block import decided_by, options_of_blocks
from clsplat.cities.choose import trainable
from clsplat.cities.scene import BlockScene
from clsplat.cities.workers import Workers
from clsplat.densify import round as growth
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.io.models.ply import read_ply, write_ply
from clsplat.io.records import write_object
from clsplat.io.runs.city import EXCHANGES, OTHERS, BlockFolder, CityFolder
from clsplat.io.runs.run import RunFolder, read_exposures
from clsplat.io.scenes.read import fingerprint
from clsplat.options import resolve
from clsplat.partition.region import Region, Space
from clsplat.partition.windows import seen_pixels
from clsplat.response import Response
from clsplat.schedule.constant import Constant
from clsplat.schedule.registry import OURS
from clsplat.training.parts.exposures import PhotoResponses
from tests.command_line import clsplat_
from tests.data.tiny_training import EVENTFUL, LEVELLED, model_digest, options_of, trained

SHORT = {"iterations": 61, "densify_until": 61, "test_every": 0}
KEEPS = {"checkpoint_every": 0, "reset_every": 0, "eval_every": 0}


def region_of(scene, share, margin=0.0):
    """The Region that owns about the first `share` of a scene's points along x."""
    world = scene.points + scene.offset
    space = Space(np.eye(3), world.mean(axis=0), np.ptp(world, axis=0) / 2)
    return Region(space, high=[np.quantile(space.to(world)[:, 0], share), np.inf, np.inf], margin=margin)


def block_of(scene, share=0.3, responses=None):
    """A BlockScene that trains about the first `share` of a scene."""
    return BlockScene(scene, region_of(scene, share, margin=0.02), {}, responses)


def trained_block(folder, block, device, **changes):
    """The RunFolder of a block's training, as `tiny_training.trained`."""
    return trained(folder, block.scene, device, **changes, parts=block.parts(options_of(**changes).exposure == "on"))


@pytest.fixture
def rounds(monkeypatch):
    """Filled by trainings: of each round, the rows, and which gaussians grew and went."""
    seen, planned = [], growth.plan_growth

    def plan_growth(round, grows, prunes):
        seen.append((round.rows, grows, prunes))
        return planned(round, grows, prunes)

    monkeypatch.setattr(growth, "plan_growth", plan_growth)
    return seen


def reached_with_bodies(block, rows):
    """bool[N]: which gaussians of a training a block may change."""
    scene, region = block.scene, block.region
    centres, sizes = (
        rows["positions"] * scene.extent + scene.offset,
        2 * scene.extent * np.exp(rows["log_scales"].max(axis=1)),
    )
    reached = region.reaches(centres)
    for step_aside in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)):
        reached &= region.reaches(centres + sizes[:, None] * step_aside)
    return reached


@pytest.mark.slow
@pytest.mark.parametrize("schedule", ["constant", "sig"])
def test_only_what_the_region_reaches_grows(item_device, city, tmp_path, rounds, schedule):
    options = {"schedule": schedule, "densify_every": 20, **SHORT}
    if schedule == "sig":
        options = {**LEVELLED, "exposure": "off", "reproject": "off", "iterations": 60}
    block = block_of(city)
    trained_block(tmp_path / "run", block, item_device, **options)
    inside = [reached_with_bodies(block, rows) for rows, *_ in rounds]
    assert sum(grows.sum() for _, grows, _ in rounds) > 100
    for reached, (_, grows, prunes) in zip(inside, rounds):
        assert not ((grows | prunes) & ~reached).any() and (~reached).sum() > 1000


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    "options",
    [
        {"reset_every": 20},
        {"schedule": "mcmc", "densify_every": 20, "mcmc_growth": 0.3, "opacity_weight": 1.0, "position_noise": 1e9},
    ],
    ids=lambda options: options.get("schedule", "constant"),
)
def test_surroundings_stay_as_they_are(item_device, city, tmp_path, options):
    """While others grow and opacities are reset, or are relocated and take random steps."""
    block, before = block_of(city), Gaussians.from_points(city.points, city.colours, 1)
    run = trained_block(tmp_path / "run", block, item_device, sh_degree=1, **{**SHORT, **options})
    after = run.load_model()
    outside = ~block.region.reaches(city.points + city.offset)
    distance, place = cKDTree(after.positions).query(before.positions)
    same = distance < 1e-5 * city.extent
    assert same[outside].all() and same[~outside].mean() < 0.2
    stays = outside & same
    for name in ("sh_constant", "opacity_logits", "quaternions"):
        assert np.array_equal(after.rows[name][place[stays]], before.rows[name][stays]), name


def test_what_covers_more_than_a_block_stays(item_device, city, tmp_path, rounds):
    """Every block sees a haze that one of them owns: changed there alone, as once on caliterra, it
    changes the tones of all others when they are merged. Nor is it pruned for its size."""
    scene, block = city, block_of(city)
    haze = int(np.argmin(scene.points[:, 0]))  # deep in the block
    first = Gaussians.from_points(city.points, city.colours, 1)
    first.rows["log_scales"][haze] = np.log(3 * scene.extent)
    first.rows["opacity_logits"][haze] = -3
    assert block.region.owns(scene.points[haze : haze + 1] + scene.offset).all()
    write_ply(tmp_path / "first.ply", first, scene.offset)
    run = trained_block(
        tmp_path / "run",
        block,
        item_device,
        sh_degree=1,
        init=str(tmp_path / "first.ply"),
        **{**SHORT, "reset_every": 20},
    )
    after = run.load_model()
    place = int(np.argmax(after.log_scales.max(axis=1)))
    for name in ("positions", "log_scales", "opacity_logits", "sh_constant", "quaternions"):
        assert np.allclose(after.rows[name][place], first.rows[name][haze], atol=1e-4), name
    assert (after.log_scales.max(axis=1) > np.log(scene.extent)).sum() == 1
    assert sum(grows.sum() for _, grows, _ in rounds) > 100


def test_the_schedule_is_asked_about_the_block_only(item_device, city, tmp_path, rounds, monkeypatch):
    """Or the surroundings would count against what the block's own pixels can tell apart."""
    asked = []
    monkeypatch.setattr(
        Constant,
        "target",
        lambda self, iteration, count, above: asked.append((self.facts.count, self.facts.pixels, count, above)),
    )
    block = block_of(city)
    trained_block(tmp_path / "run", block, item_device, engine="device", **SHORT)
    first, pixels = asked[0][:2]
    begun = Gaussians.from_points(city.points, city.colours, 0)
    assert first == trainable(city, block.region, begun.positions, begun.log_scales).sum()
    assert pixels == seen_pixels(city.reduced(8), block.region, city.reduced(8).views)
    for (rows, _, prunes), (_, _, count, above) in zip(rounds, asked, strict=True):
        inside = reached_with_bodies(block, rows)
        assert count == (inside & ~prunes).sum() < (~prunes).sum() / 2
        assert 0 < above <= count


@pytest.mark.slow
def test_a_run_leaves_its_exposures_and_a_block_starts_from_them(item_device, city, tmp_path):
    # longer than an epoch: they are recentred on the way
    options = {**LEVELLED, **KEEPS, "reproject": "off", "iterations": 40, "test_every": 8, "vignetting": "on"}
    run = trained(tmp_path / "coarse", city, item_device, **options)
    learned, held = read_exposures(run.path), run.load_checkpoint()[0]["exposure.transforms"]
    names = [view.name for view in city.split(8)[0]]
    assert list(learned) == names
    rows = [response.transform.ravel() for response in learned.values()]
    assert np.array_equal(rows, held)
    lens = learned[names[0]].vignetting
    assert lens[:3].all() and all(np.array_equal(learned[name].vignetting, lens) for name in names)
    assert np.array_equal(np.float32(lens), run.load_checkpoint()[0]["exposure.lenses"][0])
    some = {name: Response(learned[name].transform + 0.2, lens) for name in names[:5]}
    block = trained_block(
        tmp_path / "block", block_of(city, responses=some), item_device, **{**options, "iterations": 1}
    )
    after = read_exposures(block.path)
    whole = trained(tmp_path / "joint", city, item_device, parts=[PhotoResponses(some)], **options)
    moved = read_exposures(whole.path)[names[0]].transform - some[names[0]].transform
    assert 1e-4 < np.abs(moved).max() < 0.1, "a joint training learns on"
    for name in names:  # blocks do not learn
        given = some.get(name, Response())
        assert np.abs(after[name].transform - given.transform).max() < 3e-3
        assert np.allclose(after[name].vignetting, given.vignetting, atol=1e-6)


@pytest.mark.parametrize("schedule", OURS)
def test_a_coarse_run_has_smaller_photos(schedule):
    chosen = resolve({}, {"schedule": schedule, "coarse": True})
    same = resolve({}, {"schedule": schedule})
    assert chosen == replace(same, coarse=True, downscale=2.0, max_resolution=800)
    assert resolve({}, {"coarse": True, "downscale": 8.0}).downscale == 8


def test_blocks_follow_the_coarse_run(tmp_path):
    coarse = RunFolder(tmp_path)
    given = {"exposure": "auto", "coarse": True, "iterations": 9, "test_offset": 3, "sh_every": 50}
    coarse.write_options({"decisions": {"exposure": "on", "vignetting": "off", "sh_degree": 2, "levels": [2.0, 1.0]}})
    options = resolve({}, options_of_blocks(given, decided_by(coarse)))
    assert (options.exposure, options.sh_degree) == ("on", 2)
    assert options.test_every == options.test_offset == 0
    assert (options.coarse, options.downscale, options.iterations) == (False, 1, 9)
    assert options.sh_every == 50 and options.vignetting == "off"


VIEWS = list(range(1, 32, 2))
FIRST = 2000  # gaussians


@pytest.fixture
def folder(city, tmp_path):
    """A city with one block of half its views."""
    there = CityFolder(tmp_path / "city")
    there.path.mkdir()
    there.write({"fingerprint": fingerprint(city)})
    there.write_partition({"method": "by hand"})
    written(there, city)
    return there


def written(there, city, **options):
    region = region_of(city, 0.5, margin=0.05)
    starts = Gaussians.from_points(city.points[:FIRST], city.colours[:FIRST], 1)
    exposures = {view.name: Response(np.eye(3, 4) * 1.02) for view in city.views}
    values = {
        **EVENTFUL,
        "iterations": 40,
        "densify_until": 40,
        "densify_every": 10,
        "exposure": "on",
        "sh_degree": 1,
        "test_every": 0,
        **options,
    }
    return there.write_block(0, city, VIEWS, region, {}, starts, exposures, values, there.identity())


def called(block, *words):
    """(exit code, output) of `clsplat block`."""
    result = clsplat_("block", block.path, *words)
    return result.exit_code, result.output


@pytest.mark.slow
def test_a_stopped_block_ends_in_the_same_bytes(folder, city, tmp_path):
    block = folder.block(0)
    code, output = called(block, "--stop-at", "25")
    assert (
        code == 130
        and output.splitlines()[-1] == f"{block.path}: stopped, its state is saved; the same command continues"
    )
    assert not RunFolder(block.run).has_model
    code, output = called(block)
    assert (code, output.splitlines()[-1]) == (0, f"{block.run}: finished")
    run = RunFolder.open(block.run)
    assert [r["iteration"] for r in run.records() if r["event"] == "grow"] == [31]
    assert next(r["gaussians"] for r in run.records() if r["event"] == "step") == FIRST
    model = read_ply(run.path / "point_cloud.ply")
    assert model.sh_degree == 1 and run.records()[-1]["gaussians"] > FIRST
    reached = block.region()[0].reaches(model.positions + model.offset)
    assert reached.all() and model.count < FIRST, "its surroundings are those of others"

    again = CityFolder(tmp_path / "again")
    again.path.mkdir()
    again.write(folder.read())
    again.write_partition(folder.read_partition())
    other = written(again, city)
    assert called(other, "-q") == (0, "")
    assert model_digest(RunFolder(other.run)) == model_digest(run)
    assert (other.run / "exposures.json").read_bytes() == (block.run / "exposures.json").read_bytes()

    before = (block.run / "point_cloud.ply").stat().st_mtime_ns
    assert called(block) == (0, f"{block.run}: was finished before\n")
    assert (block.run / "point_cloud.ply").stat().st_mtime_ns == before
    check_other_options(block)


def check_other_options(block):
    """Whoever changes what a block is trained with does not get the old result for the new."""
    record = json.loads((block.path / "block.json").read_text())
    record["options"]["iterations"] = 41
    (block.path / "block.json").write_text(json.dumps(record))
    code, output = called(block)
    assert code == 2 and output == (
        f"error: {block.run}: was begun with iterations 40, and block.json has 41; put that back, or remove the run\n"
    )


@pytest.mark.parametrize("what", ["city", "partition"])
def test_a_block_of_another_city(folder, what):
    if what == "city":
        folder.write({"fingerprint": "0"})
    else:
        folder.write_partition({"method": "another"})
    code, output = called(folder.block(0))
    assert code == 2 and output.startswith(f"error: {folder.block(0).path}: a block of another {what} than that of ")
    assert output.count("\n") == 1 and not folder.block(0).run.exists()


@pytest.mark.parametrize(
    "options, complaint",
    [
        ({"iterations": "many"}, "option 'iterations' expects auto or a whole number"),
        ({"no_such": 1}, "unknown option"),
        ({"schedule": "constant", "rounds": 3}, "option 'rounds': has no effect with --schedule constant"),
    ],
)
def test_bad_options_of_a_block(folder, options, complaint):
    block = folder.block(0)
    (block.path / "block.json").write_text(json.dumps({**block.read(), "options": options}))
    code, output = called(block)
    assert code == 2 and complaint in output and output.count("\n") == 1


@pytest.mark.parametrize("change", ["", "another block", "another device", "gone on", "saved"])
def test_what_rests_is_taken_up_only_as_it_was_left(tmp_path, monkeypatch, change):
    block, closed, device = BlockFolder(tmp_path / "000"), [], object()
    block.run.mkdir(parents=True)
    block.exchanged(1).touch()
    saved = 100 if change == "saved" else 0
    run = SimpleNamespace(path=block.run, number=1, checkpoint_iteration=lambda: saved)
    photos = SimpleNamespace(close=lambda: closed.append(1))
    session = SimpleNamespace(device=device, photos=photos)
    rests = training_block.Begun(SimpleNamespace(session=session), run)
    monkeypatch.setattr(training_block, "_resting", [rests])
    if change == "gone on":
        block.exchanged(2).touch()
    asked = BlockFolder(tmp_path / "001") if change == "another block" else block
    found = training_block._taken_up(asked, None if change == "another device" else device)
    assert (found is rests) is (change == "") and closed == [1] * bool(change)
    assert not training_block._resting and training_block._taken_up(block, device) is None


@pytest.mark.parametrize("fill", [False, True])
def test_a_block_goes_on_once_those_have_come_as_far_with_which_it_exchanges(tmp_path, monkeypatch, fill):
    """Blocks 0, 1, 2 in a row, where the second part of block 1 fails."""
    found = {n: BlockFolder(tmp_path / f"00{n}") for n in range(4)}
    for n, others in ((0, [1]), (1, [0, 2]), (2, [1]), (3, [2])):
        found[n].path.mkdir()
        write_object(
            found[n].path / "block.json",
            {
                "number": n,
                "city": "c",
                "partition": "p",
                "options": {"device": "gpu"},
                EXCHANGES: [100, 200],
                OTHERS: others,
            },
        )
    stages = []
    city = SimpleNamespace(blocks=found.values, block=found.__getitem__, add_stage=stages.append)
    monkeypatch.setattr(training_block, "_expected_work", lambda block: 1)
    ran = []

    def train(job):
        ran.append(job.name)
        if job.name == "001, stage 2 of 3":
            raise InputError("no such photo")
        assert job.alone == (len(ran) > 9) and job.device == "gpu"
        assert f"stage {job.until or 3} of 3" in job.name or job.alone
        job.done.touch()

    engine = Workers.run
    monkeypatch.setattr(Workers, "run", lambda workers, jobs, here, *rest: engine(workers, jobs, train, *rest))
    outcomes = {
        outcome.job.block.path.name: outcome
        for outcome in training_block.train_blocks(city, Workers(), None, fill=fill)
    }
    firsts = [f"00{n}, stage 1 of 3" for n in range(4)]
    seconds = [f"00{n}, stage 2 of 3" for n in range(4)]
    last = "003, stage 3 of 3"  # needs the second parts of 2 and 3 only
    assert ran[:9] == [*firsts, *seconds, last]
    assert ran[9:] == (["000", "002"] if fill else [])
    assert [stage.name.removesuffix(", failed") for stage in stages] == ran
    assert [stage.name for stage in stages if "failed" in stage.name] == ["001, stage 2 of 3, failed"] and stages[
        0
    ].worker == "this machine"
    assert {name: outcome.ok for name, outcome in outcomes.items()} == {
        "000": True,
        "001": False,
        "002": True,
        "003": True,
    }
    assert str(outcomes["001"].error) == "no such photo"
    monkeypatch.setattr(
        Workers, "run", lambda workers, jobs, here, *rest: engine(workers, jobs, lambda job: job.done.touch(), *rest)
    )
    assert all(outcome.ok for outcome in training_block.train_blocks(city, Workers(), None))
    assert all((block.run / "point_cloud.ply").exists() for block in found.values())
