"""Streamed SOG: ranges of chunks are what the leaves of its tree say, at every level."""

import json
import shutil
import subprocess
import sys
from functools import cache

import numpy as np
import pytest
from scipy.spatial import cKDTree

from clsplat.apps import streamed_sog
from clsplat.apps.streamed_sog import write_streamed_sog
from clsplat.edit.select import selected
from clsplat.io.georeference.files import write_orientation
from clsplat.io.models.formats import read_model, write_model
from tests.apps.test_models import run_with
from tests.command_line import clsplat_
from tests.io.models.test_formats import BOUNDS, compare, model
from tests.io.models.test_ply import UTM
from tests.io.models.test_splat_transform import convert  # noqa: F401  (a fixture)

LIMIT = 300


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    gaussians = model(3000, 1, UTM)
    folder, seen = tmp_path_factory.mktemp("sog"), []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(streamed_sog, "LEAST_GAUSSIANS", 2)
        chunks = write_streamed_sog(
            folder, gaussians, ("SplatRenderMode: mip",), LIMIT, lambda *numbers: seen.append(numbers)
        )
    index = json.loads((folder / "lod-meta.json").read_text())
    assert chunks == len(index["filenames"])
    assert seen == [(number, len(seen)) for number in range(1, len(seen) + 1)]
    return folder, gaussians, index


def leaves_of(node):
    if "lods" in node:
        return [node]
    for child in node["children"]:
        assert (np.array(child["bound"]["min"]) >= node["bound"]["min"]).all()
        assert (np.array(child["bound"]["max"]) <= node["bound"]["max"]).all()
    return [leaf for child in node["children"] for leaf in leaves_of(child)]


def part_of(folder, index, lod):
    """The gaussians of a range."""
    chunk = read_model(folder / index["filenames"][lod["file"]])
    rows = np.arange(lod["offset"], lod["offset"] + lod["count"])
    assert rows[-1] < chunk.count
    return selected(chunk, rows)


@pytest.mark.slow
def test_the_finest_level_is_the_model(written):
    folder, gaussians, index = written
    leaves, found = leaves_of(index["tree"]), []
    assert len(leaves) == 16 and index["version"] == 1
    for leaf in leaves:
        part = part_of(folder, index, leaf["lods"]["0"])
        assert part.count <= LIMIT
        assert (part.positions > leaf["bound"]["min"]).all()
        assert (part.positions < leaf["bound"]["max"]).all()
        found.append(part)
    assert index["counts"][0] == gaussians.count == sum(part.count for part in found)
    assert np.array_equal(index["origin"], UTM)
    rows = {name: np.concatenate([part.rows[name] for part in found]) for name in found[0].rows}
    whole = type(found[0])(rows, 1, np.array(UTM, np.float64))
    compare(whole, gaussians, BOUNDS[".sog"])


def test_each_level_has_a_quarter_of_the_one_before(written, monkeypatch):
    folder, gaussians, index = written
    monkeypatch.setattr(sys.modules[__name__], "read_model", cache(read_model))
    leaves, counts = leaves_of(index["tree"]), index["counts"]
    assert index["lodLevels"] == len(counts) == 4 and sum(counts) == index["count"]
    for level in range(1, 4):
        assert counts[level] == pytest.approx(counts[level - 1] / 4, rel=0.1)
        for leaf in leaves:
            coarse, fine = (part_of(folder, index, leaf["lods"][str(each)]) for each in (level, level - 1))
            away, _ = cKDTree(fine.positions).query(coarse.positions)
            assert coarse.count == -(-fine.count // 4)
            assert away.max() < np.ptp(gaussians.positions, axis=0).max() / 4
    files = [name.split("_")[0] for name in index["filenames"]]
    assert [files.count(str(level)) for level in range(4)] == [16, 3, 1, 1]
    used = {(lod["file"], lod["offset"]) for leaf in leaves for lod in leaf["lods"].values()}
    assert len(used) == 4 * len(leaves)


def test_a_small_model_is_one_leaf(tmp_path):
    assert write_streamed_sog(tmp_path, model(50, 0)) == 1
    index = json.loads((tmp_path / "lod-meta.json").read_text())
    assert index["lodLevels"] == 1 and index["tree"]["lods"]["0"] == {"file": 0, "offset": 0, "count": 50}


def test_export(tmp_path, monkeypatch):
    """Upright only where that is asked for; a folder that holds something is no place for it."""
    gaussians = model(50, 1)
    run = run_with(tmp_path / "run", gaussians, (0, 0, 0))
    write_orientation(run.path, (0, 0, 1))
    for name, words in (("as_is", ()), ("upright", ("--upright",))):
        result = clsplat_("export", run.path, "-o", tmp_path / name / "lod-meta.json", *words)
        assert result.exit_code == 0, result.output
    found, turned = (read_model(tmp_path / name / "0_0" / "meta.json").positions for name in ("as_is", "upright"))
    away, match = cKDTree(found).query(gaussians.positions)
    assert away.max() < 1e-3 and len(set(match)) == 50
    assert np.abs(np.sort(-turned[:, 1]) - np.sort(gaussians.positions[:, 2])).max() < 1e-3
    for place, cause in (
        (tmp_path / "as_is" / "lod-meta.json", "as_is: exists already"),
        ("lod-meta.json", "fills a folder; name a new one"),
    ):
        monkeypatch.chdir(tmp_path)
        result = clsplat_("export", run.path, "-o", place)
        assert result.exit_code == 2 and cause in result.output
    assert not (tmp_path / "lod-meta.json").exists()


@pytest.mark.slow
def test_splat_transform_reads_chunks_and_writes_such_an_index(written, tmp_path, convert):  # noqa: F811
    folder, _, index = written
    for number in (0, len(index["filenames"]) - 1):
        path = folder / index["filenames"][number]
        found = read_model(convert(path, tmp_path / "found.ply"))
        compare(found, read_model(path), (1e-6, 1e-5, 1e-3, 1e-5, 1e-5, 1e-5))
    write_model(tmp_path / "a.ply", model(400))
    node = shutil.which("node")
    command = convert.__closure__[0].cell_contents
    subprocess.run(
        [node, command, "-q", "-w", "-g", "cpu", tmp_path / "a.ply", "-l", "0", tmp_path / "lod-meta.json"],
        check=True,
        timeout=100,
    )
    theirs = json.loads((tmp_path / "lod-meta.json").read_text())
    leaf, other = leaves_of(index["tree"])[0], leaves_of(theirs["tree"])[0]
    assert set(theirs) <= set(index) and set(leaf) == set(other)
    assert set(leaf["lods"]["0"]) == set(other["lods"]["0"])
