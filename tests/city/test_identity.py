"""A part of a city is what it says it is: files of another block, partition or city are refused."""

import shutil

import numpy as np
import pytest

from clsplat.cities.city import City
from clsplat.cities.exchange import Owned
from clsplat.cities.joint import begin_with, train_jointly
from clsplat.cities.merge import merge
from clsplat.cli.main import main
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.io.models.ply import START, start_comment, start_of, write_ply
from clsplat.io.records import digest_of
from clsplat.io.runs.city import CityFolder
from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.read import fingerprint, read_scene
from clsplat.options import resolve
from clsplat.partition.partition import Partition
from clsplat.partition.region import Region, Space
from tests.data.tiny_training import CITY

INF = np.inf


def cut_in_two(folder, scene, at=0.0):
    """A city of two blocks, west and east of `at`, whose models are their initial gaussians."""
    folder.mkdir()
    city = CityFolder(folder)
    city.write({"fingerprint": fingerprint(scene)})
    space = Space(np.eye(3), scene.offset, np.full(3, 30.0))
    regions = (Region(space, np.full(3, -INF), np.array([at, INF, INF]), 0.1),
               Region(space, np.array([at, -INF, -INF]), np.full(3, INF), 0.1))
    everything = np.arange(len(scene.views))
    partition = Partition("citygs", regions, (everything,) * 2, {})
    city.write_partition(partition.record())
    whole = Gaussians.from_points(scene.points, scene.colours, 0)
    for number, sign in enumerate((-1, 1)):
        near = sign * (whole.positions[:, 0] - 30 * at) > -3
        own = Gaussians({name: rows[near] for name, rows in whole.rows.items()}, 0)
        block = city.write_block(number, scene, everything[:4], regions[number], {}, own, None, {},
                                 city.identity())
        save(block.run, own, scene, block.start())
    return city


def save(folder, gaussians, scene, start):
    folder.mkdir(exist_ok=True)
    write_ply(folder / "point_cloud.ply", gaussians, scene.offset, start_comment(start))


@pytest.fixture(scope="module")
def scene():
    return read_scene(CITY)


@pytest.fixture
def city(scene, tmp_path):
    return cut_in_two(tmp_path / "city", scene)


@pytest.fixture
def earlier(scene, tmp_path):
    """Another partition of the same scene."""
    return cut_in_two(tmp_path / "earlier", scene, at=0.05)


def exchanged(first, second):
    aside = first.with_name("aside")
    first.rename(aside)
    second.rename(first)
    aside.rename(second)


WAYS = {  # what is exchanged -> the states of the two blocks
    "runs": (lambda city, earlier: exchanged(city.block(0).run, city.block(1).run), 2),
    "models": (lambda city, earlier: exchanged(city.block(0).run / "point_cloud.ply",
                                               city.block(1).run / "point_cloud.ply"), 2),
    "one model": (lambda city, earlier: shutil.copy(city.block(0).run / "point_cloud.ply",
                                                    city.block(1).run), 1),
    "run of an earlier partition": (lambda city, earlier: exchanged(city.block(0).run,
                                                                    earlier.block(0).run), 1),
    "model of an earlier partition": (lambda city, earlier: shutil.copy(
        earlier.block(1).run / "point_cloud.ply", city.block(1).run), 1),
    "block of an earlier partition": (lambda city, earlier: exchanged(city.block(0).path,
                                                                      earlier.block(0).path), 1),
}


@pytest.mark.parametrize("way", WAYS)
def test_what_is_exchanged_is_refused_in_one_line(city, earlier, scene, way):
    merge(city, scene).check()
    change, count = WAYS[way]
    change(city, earlier)
    merged = merge(city, scene, fill=True)
    refused = [share for share in merged.shares if share.state == "refused"]
    assert len(refused) == count and all("another" in share.note for share in refused)
    with pytest.raises(InputError, match="another (block|partition)") as error:
        merged.check()
    assert "\n" not in str(error.value) and str(city.path) in str(error.value)


def test_whole_blocks_exchanged_are_refused(city, scene):
    exchanged(city.block(0).path, city.block(1).path)
    with pytest.raises(InputError, match="two partitions are mixed"):
        merge(city, scene)


def test_a_block_that_fits_another_partition_too_is_taken(city, scene, tmp_path):
    """The same cell with the same initial gaussians: its model is as good here."""
    again = cut_in_two(tmp_path / "again", scene)
    shutil.copy(again.block(0).run / "point_cloud.ply", city.block(0).run)
    merge(city, scene).check()


def test_a_model_is_taken_without_the_points_at_which_it_began(city, scene):
    city.block(0).initial.unlink()
    merge(city, scene).check()


def test_a_joint_training_of_another_city_is_refused(city, scene):
    merged = merge(city, scene)
    city.write_partition({**city.read_partition(), "joint": {"iterations": 9}})
    whole = City(city, scene, resolve({}, {}), None)
    begin_with(whole, merged.gaussians)
    save(city.joint, merged.gaussians, scene, "0" * 64)
    with pytest.raises(InputError, match="joint training of another city"):
        train_jointly(whole, merged)
    save(city.joint, merged.gaussians, scene, digest_of(city.joint_start))
    assert train_jointly(whole, merged).count == merged.count


@pytest.mark.slow
def test_a_trained_city_refuses_exchanged_parts_and_keeps_its_model(tmp_path, capsys):
    folder = CityFolder(tmp_path / "city")

    def clsplat(*words):
        with pytest.raises(SystemExit) as ended:
            main([*map(str, words)])
        return ended.value.code, capsys.readouterr().err

    words = ("city", CITY, "-r", "8", "-n", "300", "--grid", "2x1", "--exchanges", "1",
             "--joint-steps", "none", "--workers", "1", "-o", folder.path, "-q")
    assert clsplat(*words)[0] == 0
    first, second = folder.blocks()
    for block in (first, second):
        assert start_of(block.run / "point_cloud.ply") == block.start()
        assert RunFolder(block.run).read_options()[START] == block.start()
    model = (folder.path / "point_cloud.ply").read_bytes()
    exchanged(first.run, second.run)
    for command in (words, ("merge", folder.path), ("merge", folder.path, "--fill"),
                    ("merge", folder.path, "--tree", "--overwrite")):
        code, error = clsplat(*command)
        assert code == 2 and error.count("\n") == 1, error
    assert "of another block" in error or "No such option" in error
    assert (folder.path / "point_cloud.ply").read_bytes() == model
    exchanged(first.run, second.run)
    record = first.read()
    Owned(second, 1, record)
    exchanged(first.exchanged(1), second.exchanged(1))
    with pytest.raises(InputError, match="of another block or partition"):
        Owned(second, 1, record)
