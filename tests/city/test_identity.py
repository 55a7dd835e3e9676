"""A part of a city is what it says it is: files of another block, partition or city are refused."""


import numpy as np
import pytest

from clsplat.cities.merge import merge
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.io.models.ply import start_comment, write_ply
from clsplat.io.runs.city import CityFolder
from clsplat.io.scenes.read import fingerprint, read_scene
from clsplat.partition.region import Partition, Region, Space
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
    "models": (lambda city, earlier: exchanged(city.block(0).run / "point_cloud.ply",
                                               city.block(1).run / "point_cloud.ply"), 2),
    "run of an earlier partition": (lambda city, earlier: exchanged(city.block(0).run,
                                                                    earlier.block(0).run), 1),
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
