"""The folder of a city: what is written is read back, whole or not at all."""

import errno
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from clsplat.cities.block import options_of_blocks
from clsplat.cities.scene import BlockScene, SampleWeights
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.georeference import Georeference
from clsplat.io.models.ply import read_ply
from clsplat.io.photos.depth import read_depth, with_depths
from clsplat.io.photos.images import write_image
from clsplat.io.photos.views import read_valid
from clsplat.io.records import digest_of
from clsplat.io.runs import city as module
from clsplat.io.runs.city import BlockFolder, CityFolder
from clsplat.io.runs.run import read_exposures
from clsplat.io.scenes import write
from clsplat.io.scenes.read import fingerprint, read_scene
from clsplat.partition.region import Region, Space
from clsplat.response import Response
from tests.data.tiny_training import CITY
from tests.refusals import refused

VIEWS = [3, 9, 8, 11]  # in no order
WEST = Region(Space(np.eye(3), np.zeros(3), np.ones(3)), high=[0.0, np.inf, np.inf], margin=0.1)
OPTIONS = {"iterations": 30, "levels": (2.0, 1.0), "exposure": "on"}


@pytest.fixture(scope="module")
def scene():
    return read_scene(CITY).part(range(12))


@pytest.fixture
def city(tmp_path, scene):
    folder = CityFolder(tmp_path / "city")
    folder.path.mkdir()
    folder.write({"fingerprint": fingerprint(scene), "scene": str(scene.path)})
    folder.write_partition({"method": "by hand"})
    return folder


@pytest.fixture(scope="module")
def gaussians(scene):
    return Gaussians.from_points(scene.points[:50], scene.colours[:50], 1)


def exposures_of(scene):
    return {
        view.name: Response(np.eye(3, 4) + 0.01 * i / 3, np.array([0.1, -0.2, i / 3, 1.5]))
        for i, view in enumerate(scene.views[:10])
    }


def written(folder, scene, gaussians, number=0, views=VIEWS, **identity):
    return folder.write_block(
        number, scene, views, WEST, {}, gaussians, exposures_of(scene), OPTIONS, {**folder.identity(), **identity}
    )


def files(block):
    return {path.relative_to(block.path).as_posix() for path in block.path.rglob("*")}


def sightings(scene):
    """{(place of the point to 1e-4, view)} of the observations."""
    point, view = scene.observations.T
    places = np.round((scene.points + scene.offset)[point], 4)
    return {(*place, scene.views[v].name) for place, v in zip(places.tolist(), view)}


def check_part(block, scene, views=VIEWS):
    """The block's folder holds the part of the scene that its views show, in the same world."""
    read = read_scene(block.path)
    chosen = [scene.views[i] for i in sorted(views)]
    assert [view.name for view in read.views] == [view.name for view in chosen]
    for view, other in zip(read.views, chosen):
        assert view.camera.width == other.camera.width
        assert np.allclose(view.camera.rotation, other.camera.rotation, atol=1e-12)
        moved = view.camera.position + read.offset - other.camera.position - scene.offset
        assert np.abs(moved).max() < 1e-6
        assert bytes_of(view) == bytes_of(other)
    assert sightings(read) == {row for row in sightings(scene) if row[3] in {view.name for view in chosen}}
    assert block.region()[0].record() == WEST.record()
    return read


def bytes_of(view):
    return view.source if isinstance(view.source, bytes) else view.source.read_bytes()


@pytest.mark.parametrize("away", [0.0, 5e6])
def test_a_block_is_a_scene(city, scene, gaussians, away):
    far = replace(scene, offset=scene.offset + away)
    block = written(city, far, gaussians)
    read = check_part(block, far)
    assert 0 < len(read.points) < len(scene.points)
    assert all(view.source.is_symlink() for view in read.views)
    expected = exposures_of(scene)
    assert set(read_exposures(block.path)) == {scene.views[i].name for i in (3, 8, 9)}
    for name, response in read_exposures(block.path).items():
        assert np.array_equal(response.transform, expected[name].transform)
        assert np.array_equal(response.vignetting, expected[name].vignetting)
    there = read_ply(block.initial, far.offset)
    assert np.allclose(there.positions, gaussians.positions, atol=1e-4)
    assert block.read() == {
        "number": 0,
        **city.identity(),
        "start": digest_of(block.initial),
        "options": {**OPTIONS, "levels": [2.0, 1.0]},
        "format": 1,
    }
    block.check()
    model = pycolmap.Reconstruction(str(block.path / "sparse" / "0"))
    assert model.compute_mean_reprojection_error() < 1e-6  # tracks lie on their points


def test_a_block_keeps_the_place_of_the_whole(city, scene, gaussians):
    here = Georeference("EPSG:32614", (5e5, 3e6, 300.0), "test", 0.5)
    block = written(city, replace(scene, georeference=here, given_up=None), gaussians)
    read = read_scene(block.path)
    assert read.georeference == here and read.up.tolist() == [0, 0, 1]
    estimated = read_scene(written(city, scene, gaussians, number=1).path)
    assert estimated.georeference is None and np.allclose(estimated.up, scene.up, atol=1e-15)


def test_masks_and_depth_maps_of_a_block(city, scene, gaussians, tmp_path):
    mask, depth = tmp_path / "mask.png", tmp_path / "far" / "depth.npy"
    write_image(mask, np.tile((np.arange(320) > 99)[:, None] * np.uint8(255), (240, 1, 3)))
    depth.parent.mkdir()
    np.save(depth, np.full((240, 320), 7.0))
    views = list(scene.views)
    views[3], views[9] = replace(views[3], mask=mask), replace(views[9], depth=depth)
    block = written(city, replace(scene, views=tuple(views)), gaussians)
    read = check_part(block, scene)
    assert [view.mask is not None for view in read.views] == [True, False, False, False]
    assert np.array_equal(read_valid(read.views[0]), read_valid(views[3]))
    held = with_depths(read, options_of_blocks({"depth": "elsewhere"}, {})["depth"])
    assert [view.depth is not None for view in held.views] == [False, False, True, False]
    assert (read_depth(held.views[2]) == 7).all()


@pytest.mark.parametrize("moment", ["write.link_file", "write_ply"])
@pytest.mark.parametrize(
    "trouble",
    [
        KeyboardInterrupt(),
        OSError(errno.ENOSPC, "disk full"),
        InputError("file: cannot be written (disk full); free some space"),
    ],
    ids=["interrupted", "full", "a full file"],
)
def test_a_block_is_whole_or_not_there(city, scene, gaussians, monkeypatch, moment, trouble):
    def end(*_, **__):
        raise trouble

    *holder, name = moment.split(".")
    with monkeypatch.context() as patch:
        patch.setattr(write if holder else module, name, end)
        with pytest.raises((InputError, KeyboardInterrupt)) as caught:
            written(city, scene, gaussians)
    assert caught.value is trouble or str(caught.value).startswith(
        f"{city.block(0).path}: cannot be written (disk full); "
    )
    assert not list((city.path / "blocks").iterdir()) and city.blocks() == []
    (city.path / "blocks" / "000.part" / "sparse").mkdir(parents=True)  # of a killed process
    block, other = written(city, scene, gaussians), written(city, scene, gaussians, number=1)
    assert files(block) == files(other) and "block.json" in files(block)
    assert sorted(path.name for path in (city.path / "blocks").iterdir()) == ["000", "001"]


def test_a_block_that_is_there_is_left_alone(city, scene, gaussians):
    block = written(city, scene, gaussians)
    (block.path / "run").mkdir()
    before = block.initial.stat().st_mtime_ns
    assert written(city, scene, gaussians).path == block.path
    assert block.initial.stat().st_mtime_ns == before and (block.path / "run").exists()
    record = block.read()
    assert record.pop("format") == 1
    (block.path / "block.json").write_text(json.dumps(record))  # as before there was a number
    assert written(city, scene, gaussians).path == block.path and block.read() == record
    city.write_partition({"method": "another"})
    refused(lambda: written(city, scene, gaussians), "holds a block of another partition")
    assert (block.path / "run").exists()


DAMAGED = ["", "[]", '{"number": "1"}', '{"fingerprint": 3}', '{"a": NaN}', "\xff"]


@pytest.mark.parametrize("text", DAMAGED, ids=repr)
@pytest.mark.parametrize(
    "name", ["city.json", "blocks/000/block.json", "blocks/000/region.json", "blocks/000/exposures.json"]
)
@pytest.mark.one_in(5)
def test_damaged_files(city, scene, gaussians, name, text):
    if name.endswith("exposures.json") and text.startswith('{"n'):
        text = json.dumps({scene.views[3].name: [1.0] * 11})
    block = written(city, scene, gaussians)
    (city.path / name).write_text(text, encoding="latin-1")
    readers = {"city.json": city.identity, "block.json": block.read}
    with pytest.raises(InputError, match=f"{Path(name).name}: .*damaged") as caught:
        readers.get(Path(name).name, lambda: BlockScene.read(block))()
    assert "\n" not in str(caught.value)


def test_what_is_missing_is_named(tmp_path):
    refused(BlockFolder(tmp_path).check, "block.json: no such file; give a folder CITY/blocks")
    refused(CityFolder(tmp_path).identity, "partition.json: no such file; make it with `clsplat p")
    refused(CityFolder(tmp_path).read, "city.json: no such file; give a folder that")


def test_a_city_begins_in_a_folder_of_its_own(tmp_path):
    folder = CityFolder(tmp_path / "out")
    folder.check_free()
    for name in ("coarse", ".lock"):
        (folder.path / name).mkdir(parents=True)
    folder.check_free()
    (folder.path / "images").mkdir()
    refused(folder.check_free, "holds images, but no city")


def test_visits_travel_with_the_block(city, scene, gaussians):
    names = [scene.views[index].name for index in VIEWS]
    block = city.write_block(
        0, scene, VIEWS, WEST, {}, gaussians, None, OPTIONS, city.identity(), visits={names[0]: 0.25}
    )
    parts = BlockScene.read(block).parts(False)
    weights = next(part for part in parts if isinstance(part, SampleWeights))
    assert weights.visits(read_scene(block.path).views).tolist() == [
        0.25 if view.name == names[0] else 1.0 for view in read_scene(block.path).views
    ]
