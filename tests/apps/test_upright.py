"""`clsplat export` in every format, as the model is and upright."""

import json

import numpy as np
import pytest

from clsplat.estimate.trial_steps import sampled
from clsplat.gaussians import Gaussians
from clsplat.georeference import Georeference
from clsplat.io.georeference.files import read_georeference, write_georeference, write_orientation
from clsplat.io.models.formats import SUFFIXES, read_model
from tests.apps.test_models import run_with
from tests.estimate.test_plan import city, clsplat_

__all__ = ["city"]


@pytest.fixture
def run(tmp_path, city):
    """A run of a few gaussians, two of which are invisible, and whose scene is georeferenced."""
    gaussians = sampled(city, 60, 3)
    gaussians.opacity_logits[[3, 5]] = -20
    gaussians.sh_rest[:, :3] = np.random.default_rng(0).uniform(-0.5, 0.5, (60, 3, 3))
    made = run_with(tmp_path / "run", gaussians)
    write_orientation(made.path, (0, 0, 1))
    write_georeference(made.path, Georeference("EPSG:32614", (1000, 2000, 3000), "GPS", 0.1))
    return made


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_every_format(run, tmp_path, suffix):
    if suffix in (".las", ".laz"):
        pytest.importorskip("laspy", reason="laspy is an extra: pip install '.[geo]'")
    output = tmp_path / f"model{suffix}"
    result = clsplat_("export", run.path, "-o", output)
    assert result.exit_code == 0, result.output
    degree = 0 if suffix in (".las", ".laz") else 1
    assert f"58 gaussians, spherical harmonics to degree {degree}; left out as in" in result.output
    whole = read_model(run.model_path)
    found = read_model(output, whole.offset, read_georeference(run.path))
    assert (found.count, found.sh_degree) == (58, degree)
    low, high = (whole.positions.min(axis=0), whole.positions.max(axis=0))
    assert ((found.positions > low - 0.1) & (found.positions < high + 0.1)).all()
    assert np.abs(np.median(found.positions, axis=0) - np.median(
        np.delete(whole.positions, [3, 5], axis=0), axis=0)).max() < 0.1


def test_upright(run, tmp_path):
    result = clsplat_("export", run.path, "-o", tmp_path / "a.ply", "--upright")
    assert result.exit_code == 0, result.output
    found, whole = read_model(tmp_path / "a.ply"), read_model(run.model_path)
    keep = np.delete(np.arange(60), [3, 5])
    height = (whole.positions.astype(np.float64) + whole.offset)[keep, 2]
    assert np.allclose(-(found.positions + found.offset)[:, 1], height, atol=1e-4)
    head = (tmp_path / "a.ply").read_bytes()[:600]
    assert b"comment up 0 -1 0\n" in head and b"map_offset" not in head
    result = clsplat_("export", run.path, "-o", tmp_path / "tiles", "--upright")
    assert result.exit_code == 2 and "3D Tiles are upright" in result.stderr


def test_gltf_knows_where_it_lies(run, tmp_path):
    assert clsplat_("export", run.path, "-o", tmp_path / "a.glb").exit_code == 0
    data = (tmp_path / "a.glb").read_bytes()
    document = json.loads(data[20:20 + int.from_bytes(data[12:16], "little")])
    assert document["asset"]["extras"]["comments"][0] == "SplatRenderMode: default"
    assert any(line.startswith("map_offset 1000.0 2000.0 3000.0")
               for line in document["asset"]["extras"]["comments"])
    assert isinstance(read_model(tmp_path / "a.glb"), Gaussians)
