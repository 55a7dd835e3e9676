"""Dense points of a city: when they are found, and that its blocks begin with them."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.cities import dense
from clsplat.cities.city import City
from clsplat.cities.dense import find_dense_gaussians, search_of
from clsplat.errors import InputError, Interrupted
from clsplat.io.models.ply import read_ply
from clsplat.io.runs.city import CityFolder
from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.read import read_scene
from clsplat.options import resolve
from tests.city.test_city import city
from tests.data.tiny_training import CITY, records

LONG = {"iterations": 700, "downscale": 4.0, "exposure": "off", "reproject": "off"}


@pytest.fixture(scope="module")
def scene():
    return replace(read_scene(CITY).part(range(8, 18)), observations=None)


@pytest.fixture
def folder(tmp_path):
    return CityFolder(tmp_path)


@pytest.mark.slow
def test_they_are_those_with_which_one_run_begins(folder, scene, item_device):
    whole = City(folder, scene, resolve({}, {**LONG, "pixels_per_gaussian": 4.0}), item_device)
    find_dense_gaussians(whole)
    found = whole.dense_gaussians(2)
    assert found.sh_degree == 2 and found.count > len(scene.points)
    low, high = np.percentile(scene.points, (1, 99), axis=0)
    within = ((found.positions > low - 2) & (found.positions < high + 2)).all(axis=1)
    assert within.mean() > 0.9
    before = folder.dense.stat().st_mtime_ns
    find_dense_gaussians(whole)
    assert folder.dense.stat().st_mtime_ns == before


@pytest.mark.slow
def test_a_job_finds_the_same_ones_and_can_be_stopped(tmp_path, item_device):
    scene = read_scene(CITY)
    options = resolve({}, {**LONG, "downscale": 8.0, "pixels_per_gaussian": 4.0})
    found = []
    for name in ("here", "job"):
        whole = City(CityFolder(tmp_path / name), scene, options, item_device)
        whole.begin()
        job = search_of(whole)
        if name == "here":
            find_dense_gaussians(whole)
        else:
            with pytest.raises(Interrupted):
                job.run(item_device, stopping=lambda: True)
            assert not job.is_done
            _, seconds = job.run(item_device)
            assert seconds > 0
        assert job.is_done
        found.append(whole.folder.dense.read_bytes())
    assert found[0] == found[1]


@pytest.mark.parametrize("options", [{"init": "sfm"}, {"iterations": 10}, {"schedule": "constant"}], ids=str)
def test_no_city_has_them_where_one_run_begins_at_sparse_points(folder, scene, options):
    whole = City(folder, scene, resolve({}, {**LONG, **options}), None)
    find_dense_gaussians(whole)
    assert not folder.dense.exists() and whole.dense_gaussians(1) is None


def test_a_city_that_is_cut_stays_as_it_is(folder, scene, monkeypatch):
    monkeypatch.setattr(dense, "prepare", None)
    folder.write_partition({"method": "by hand"})
    find_dense_gaussians(City(folder, scene, resolve({}, LONG), None))
    assert not folder.dense.exists()


def test_they_were_requested_and_cannot_be_had(folder, scene):
    alone = replace(scene, observations=np.zeros((0, 2), np.int32))
    with pytest.raises(InputError, match="--init dense needs three photos"):
        find_dense_gaussians(City(folder, alone, resolve({}, {**LONG, "init": "dense"}), None))


@pytest.mark.nightly
def test_blocks_begin_with_them(tmp_path, capsys):
    made = city(tmp_path / "dense", "--init", "dense")
    found = read_ply(made.dense).count
    added = [block.read("dense")["dense"] for block in made.blocks()]
    assert min(added) > 100 and max(added) < found
    for block, more in zip(made.blocks(), added):
        record = block.read("own", "margin", "surroundings")
        assert read_ply(block.initial).count == more + sum(record[key] for key in ("own", "margin", "surroundings"))
    assert records(RunFolder(made.coarse), "plan")[0]["reasons"]["init"].startswith("sfm")
    again = [path.stat().st_mtime_ns for path in (made.dense, made.block(0).initial)]
    (made.path / "point_cloud.ply").unlink()
    city(made.path, "--init", "dense")
    assert again == [path.stat().st_mtime_ns for path in (made.dense, made.block(0).initial)]
    sparse = city(tmp_path / "sparse", "--init", "sfm")
    assert not sparse.dense.exists() and "dense" not in sparse.block(0).read()
    merged = [records(each, "merge")[-1]["gaussians"] for each in (made, sparse)]
    assert merged[0] > merged[1] + 100
    city(tmp_path / "random", "--init", "random", code=2)
    assert "--init sfm or dense" in capsys.readouterr().err
