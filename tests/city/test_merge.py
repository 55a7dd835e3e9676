"""Blocks to one model: every gaussian owned once, and nothing missing in silence."""

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from clsplat.cities.city import City
from clsplat.cities.merge import joined, merge, merged_city
from clsplat.errors import InputError
from clsplat.gaussians import LEARNED, Gaussians
from clsplat.io.models.ply import read_ply, start_comment, write_ply
from clsplat.io.runs.city import CityFolder
from clsplat.io.runs.run import read_exposures, write_exposures
from clsplat.io.scenes.read import fingerprint, read_scene
from clsplat.options import resolve
from clsplat.partition.region import Space
from clsplat.report.city import share_table
from clsplat.response import Response
from tests.city.test_seams import boxes
from tests.data.tiny_training import CITY

BLOCKS = 4


@pytest.fixture(scope="module")
def scene():
    return read_scene(CITY)


def quarters(scene, middle=(0.0, 0.0)):
    """Partition of the sample city in 2 x 2 cells that meet above `middle`, local."""
    (x, y), inf = np.array(middle) / 30, np.inf
    cells = [([-inf, -inf], [x, y]), ([x, -inf], [inf, y]), ([-inf, y], [x, inf]), ([x, y], [inf, inf])]
    return replace(
        boxes(cells, Space(np.eye(3), scene.offset, np.full(3, 30.0))),
        dropped={3: "it sees nothing"},
        views=(np.arange(len(scene.views)),) * BLOCKS,
    )


def strewn(count, degree=1, seed=0):
    """Gaussians all over the city and beyond, in its local frame."""
    rng = np.random.default_rng(seed)
    rows = {field.name: rng.normal(size=(count, *field.row_shape(degree))).astype(np.float32) for field in LEARNED}
    rows["positions"] *= 40
    return Gaussians(rows, degree)


@pytest.fixture(scope="module")
def trained_city(scene, tmp_path_factory):
    """A city whose four blocks all ended with the same model, `strewn(2000)`, uncropped."""
    folder = CityFolder(tmp_path_factory.mktemp("trained"))
    folder.write({"fingerprint": fingerprint(scene)})
    partition = quarters(scene)
    folder.write_partition(partition.record())
    initial = strewn(10)
    for number in range(BLOCKS):
        block = folder.write_block(
            number,
            scene,
            partition.views[number][:4],
            partition.regions[number],
            {},
            initial,
            None,
            {},
            folder.identity(),
        )
        finish(block, strewn(2000), scene.offset)
    folder.coarse.mkdir()
    write_ply(folder.coarse / "point_cloud.ply", strewn(600, seed=5), scene.offset)
    return folder


@pytest.fixture
def city(trained_city, tmp_path):
    return CityFolder(shutil.copytree(trained_city.path, tmp_path / "city", symlinks=True))


def finish(block, gaussians, offset, start=None):
    block.run.mkdir(exist_ok=True)
    write_ply(block.run / "point_cloud.ply", gaussians, offset, start_comment(start or block.start()))


def sorted_rows(gaussians):
    table = np.concatenate([gaussians.rows[f.name].reshape(gaussians.count, -1) for f in LEARNED], axis=1)
    return table[np.lexsort(table.T)]


def states(merged):
    return [share.state for share in merged.shares]


def test_every_gaussian_is_owned_once(city, scene):
    """Four times the same model is once that model again, block by block."""
    merged = merge(city, scene)
    merged.check()
    partition, ends = quarters(scene), np.cumsum([share.gaussians for share in merged.shares])
    for region, end, share in zip(partition.regions, ends, merged.shares):
        own = merged.gaussians.positions[end - share.gaussians : end] + scene.offset
        assert region.owns(own).all()
    whole = read_ply(city.block(0).run / "point_cloud.ply", scene.offset)
    assert np.array_equal(sorted_rows(merged.gaussians), sorted_rows(whole))
    assert sum(share.gaussians for share in merged.shares) == 2000
    assert min(share.gaussians for share in merged.shares) > 300
    assert sum(share.points for share in merged.shares) == len(scene.points)
    assert merged.dropped == {scene.views[3].name: "it sees nothing"}
    assert scene.views[3].name in share_table(merged.record()).text()
    assert json.loads(json.dumps(merged.record()))["gaussians"] == 2000


def test_a_block_has_its_own_offset(city, scene):
    """A block is recentred by itself: what its file says in the world is what counts."""
    block = city.block(1)
    path = block.run / "point_cloud.ply"
    before = merge(city, scene).gaussians
    write_ply(
        path, Gaussians({**strewn(2000).rows, "positions": strewn(2000).positions - np.float32(8)}, 1), scene.offset + 8
    )
    after = merge(city, scene).gaussians
    assert after.count == before.count
    assert np.allclose(after.positions, before.positions, atol=1e-4)


def test_harmonics_are_brought_to_the_highest_degree(city, scene):
    finish(city.block(2), strewn(2000, degree=3), scene.offset)
    finish(city.block(3), strewn(2000, degree=0), scene.offset)
    merged = merge(city, scene)
    gaussians, shares = merged.gaussians, merged.shares
    assert gaussians.sh_degree == 3 and gaussians.sh_rest.shape[1:] == (15, 3)
    first = shares[0].gaussians
    plain = joined([strewn(2000)])
    assert (gaussians.sh_rest[:first, 3:] == 0).all()
    assert np.isin(gaussians.sh_rest[:first, :3], plain.sh_rest).all()
    assert (gaussians.sh_rest[-shares[3].gaussians :] == 0).all()
    assert (gaussians.sh_rest[-shares[3].gaussians - 1, 3:] != 0).any()


def broken(city, scene, fault):
    if fault == "missing":
        shutil.rmtree(city.block(2).path)
    elif fault == "unfinished":
        (city.block(2).run / "point_cloud.ply").unlink()
    elif fault == "damaged":
        path = city.block(2).run / "point_cloud.ply"
        path.write_bytes(path.read_bytes()[:-100])
    elif fault == "start":
        finish(city.block(2), strewn(2000), scene.offset, 64 * "0")
    elif fault in ("city", "partition"):
        path = city.block(2).path / "block.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), fault: "another"}))


@pytest.mark.parametrize("fault", ["missing", "unfinished"])
def test_a_block_that_lacks_is_named_and_can_be_filled(city, scene, fault):
    broken(city, scene, fault)
    merged = merge(city, scene)
    assert states(merged) == ["merged", "merged", fault, "merged"]
    assert merged.shares[2].gaussians == 0 and fault in share_table(merged.record()).text()
    with pytest.raises(InputError, match=f"1 of 4 blocks .*: 002 {fault}; .*blocks/002.*--fill"):
        merged.check()
    assert not quarters(scene).regions[2].owns(merged.gaussians.positions + scene.offset).any()

    filled = merge(city, scene, fill=True)
    filled.check()
    assert states(filled) == ["merged", "merged", "coarse", "merged"]
    assert filled.shares[2].note.startswith(fault)
    coarse = strewn(600, seed=5).positions
    inside = quarters(scene).regions[2].owns(coarse + scene.offset)
    assert filled.shares[2].gaussians == inside.sum() > 50
    assert filled.gaussians.count == merged.gaussians.count + inside.sum()
    begin = sum(share.gaussians for share in filled.shares[:2])
    assert np.allclose(filled.gaussians.positions[begin : begin + inside.sum()], coarse[inside], atol=1e-5)


@pytest.mark.parametrize(
    "fault, cause",
    [
        ("damaged", "damaged or cut short"),
        ("city", "a block of another city"),
        ("start", "is of another block, partition or city than"),
        ("partition", "a block of another partition"),
    ],
)
def test_a_block_that_must_not_be_merged_is_refused_even_when_filling(city, scene, fault, cause):
    broken(city, scene, fault)
    for fill in (False, True):
        merged = merge(city, scene, fill)
        assert states(merged)[2] == "refused" and cause in merged.shares[2].note
        with pytest.raises(InputError, match=f"002 refused; .*{cause}"):
            merged.check()


def test_a_cell_without_points_may_be_empty(city, scene):
    """At the border of a city there may be nothing to train."""
    partition = quarters(scene, middle=(500.0, 500.0))
    city.write_partition(partition.record())
    for number in range(BLOCKS):
        path = city.block(number).path / "block.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), **city.identity()}))
    merged = merge(city, scene)
    merged.check()
    assert [share.gaussians for share in merged.shares] == [2000, 0, 0, 0]


@pytest.mark.parametrize("name, number", [("007", 7), ("0000", 0), ("003", 2)])
def test_a_folder_of_another_partition_is_refused(city, scene, name, number):
    target = city.path / "blocks" / name
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(city.block(1).path, target, symlinks=True)
    record = json.loads((target / "block.json").read_text())
    (target / "block.json").write_text(json.dumps({**record, "number": number}))
    with pytest.raises(InputError, match=f"{name}: says that it is block {number} of 4; two part"):
        merge(city, scene)


def test_a_city_of_another_scene_is_refused(city, scene):
    city.write({"fingerprint": "another", "scene": str(scene.path), "options": {}})
    with pytest.raises(InputError, match="has changed since; put it back"):
        City.open(city)


def test_the_merged_run_has_the_exposures_of_the_coarse_run(city, scene):
    """By which its held-out views are scored; a coarse run without any leaves none."""
    whole = City(city, scene, resolve({}, {}), SimpleNamespace(name="none", form="item", tuning={}))
    merged_city(whole)
    assert read_exposures(city.path) is None
    known = {scene.views[1].name: Response(1.1 * np.eye(3, 4), np.array([-0.1, 0, 0.2, 1.5]))}
    write_exposures(city.coarse, known)
    merged_city(whole)
    ((name, found),) = read_exposures(city.path).items()
    assert name in known and np.array_equal(found.transform, known[name].transform)
    assert np.array_equal(found.vignetting, known[name].vignetting)
