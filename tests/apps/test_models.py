"""`clsplat export` in every format, as the model is and upright, without what no view shows."""

from functools import partial

import numpy as np
import pytest

from clsplat.edit.select import alive
from clsplat.estimate.trial_steps import sampled
from clsplat.gaussians import Gaussians
from clsplat.georeference import Georeference
from clsplat.io.georeference.files import read_georeference, write_georeference, write_orientation
from clsplat.io.models.formats import SUFFIXES, read_model
from clsplat.io.models.ply import read_ply
from clsplat.io.runs.run import RunFolder
from clsplat.rendering.pipeline import Renderer
from tests.data.tiny_training import CITY
from tests.estimate.test_plan import city, clsplat_

__all__ = ["city"]


def faint(gaussians, rows, logit):
    logits = gaussians.opacity_logits.copy()
    logits[rows] = logit
    return Gaussians({**gaussians.rows, "opacity_logits": logits}, gaussians.sh_degree)


def test_dead_gaussians_change_no_pixel(float_device, city):
    gaussians = sampled(city, 3000, 0)
    threshold = np.log(1 / 254)  # of the logit of 1/255
    dead = np.arange(0, 3000, 3)
    gaussians = faint(gaussians, dead, threshold - 1e-3)
    gaussians = faint(gaussians, dead + 1, threshold + 1e-3)
    keep = alive(gaussians)
    assert np.array_equal(np.flatnonzero(~keep), dead)
    renderer, camera = Renderer(float_device, 0, city.near_plane), city.views[0].camera
    images = []
    for rows in (gaussians.rows, {name: values[keep] for name, values in gaussians.rows.items()}):
        held = {name: float_device.upload(values) for name, values in rows.items()}
        frame = renderer.render(held, renderer.pack(camera), camera.width, camera.height, 0)
        images.append(frame.image.download())
    assert np.array_equal(*images) and images[0].std() > 0.01


def run_with(folder, gaussians, offset=(5e6, 0, 0)):
    run = RunFolder.create(folder)
    run.write_options({"scene": str(CITY), "downscale": 8.0})
    run.save_model(gaussians, offset, comments=("SplatRenderMode: default",))
    return run


def test_export_leaves_out_what_carries_nothing(tmp_path, city):
    gaussians = sampled(city, 300, 3)
    gaussians.sh_rest[:] = np.random.default_rng(0).normal(size=gaussians.sh_rest.shape)
    gaussians = faint(gaussians, [7, 9], -20)
    run, output = run_with(tmp_path / "run", gaussians), tmp_path / "model.ply"
    result = clsplat_("export", run.path, "-o", output, "--sh-degree", 2)
    assert result.exit_code == 0, result.output
    assert "298 gaussians, spherical harmonics to degree 2; left out as inv" in result.output
    whole, part = read_ply(run.path / "point_cloud.ply"), read_ply(output)
    keep = alive(gaussians)
    assert part.sh_degree == 2 and b"SplatRenderMode: default" in output.read_bytes()[:400]
    for name, values in whole.rows.items():
        expected = values[keep][:, :8] if name == "sh_rest" else values[keep]
        assert np.array_equal(part.rows[name], expected), name
    before = output.read_bytes()
    result = clsplat_("export", run.path, "-o", output)
    assert result.exit_code == 2 and "exists already; replace it with --over" in result.stderr
    assert output.read_bytes() == before
    export = partial(clsplat_, "export", run.path, "-o", output, "--overwrite")
    assert export().exit_code == 0
    assert (read_ply(output).sh_degree, read_ply(output).count) == (3, 298)
    assert export("--sh-degree", 0).exit_code == 0 and read_ply(output).sh_degree == 0


def test_edit_removes_what_few_photos_show(tmp_path, city):
    gaussians = sampled(city, 60, 3)
    gaussians.positions[[3, 5], 2] += 1e4
    run = run_with(tmp_path / "run", gaussians, city.offset)
    clsplat_("export", run.path, "-o", tmp_path / "a.ply")
    for source in ((run.path,), (tmp_path / "a.ply", "--scene", CITY)):
        output = tmp_path / "out.ply"
        result = clsplat_("edit", *source, "-o", output, "--overwrite", "--min-support", 2)
        assert "2 of 60 gaussians lie where fewer than 2 photos look" in result.output
        assert read_ply(output).count == 58 and read_ply(output).positions.max() < 1e3


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
    assert (
        np.abs(np.median(found.positions, axis=0) - np.median(np.delete(whole.positions, [3, 5], axis=0), axis=0)).max()
        < 0.1
    )


def test_versions_of_spz(run, tmp_path):
    pytest.importorskip("zstandard", reason="an extra: pip install '.[spz]'")
    export = partial(clsplat_, "export", run.path, "--overwrite", "-o")
    for given, magic in (((), b"\x1f\x8b"), ((4,), b"NGSP\4\0\0\0"), ((3,), b"\x1f\x8b")):
        assert export(tmp_path / "a.spz", *["--spz-version"] * len(given), *given).exit_code == 0
        assert (tmp_path / "a.spz").read_bytes().startswith(magic)
        assert read_model(tmp_path / "a.spz").count == 58
    result = export(tmp_path / "a.sog", "--spz-version", 4)
    assert result.exit_code == 2 and "--spz-version: is for .spz; leave it out" in result.stderr


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
