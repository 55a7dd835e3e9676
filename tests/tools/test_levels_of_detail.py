"""The study of levels of detail: how cameras move away, and whether its numbers are right."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.city.lod import Detail
from clsplat.errors import InputError
from clsplat.evaluation.metrics import psnr
from clsplat.evaluation.run import Run, to_render
from clsplat.evaluation.views import opened, photo_of, render_view
from clsplat.io.models.ply import read_ply
from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.read import read_scene
from clsplat.options import resolve
from clsplat.training.loop import train
from tests.city.test_lod_runs import run
from tests.data.tiny_training import CITY
from tools.studies.levels_of_detail import compare_views, main, moved_away, supersampled

__all__ = ["run"]


@pytest.fixture(scope="module")
def scene():
    return read_scene(CITY)


def test_moved_away_shows_what_it_saw_in_the_part_that_it_names(scene):
    camera = scene.views[3].camera
    for factor in (0.5, 3.0):
        moved, part = moved_away(camera, scene.points, factor)
        pixel, depth = camera.project(scene.points)
        size = camera.width, camera.height
        seen = (depth > 0) & (pixel >= 0).all(axis=1) & (pixel < size).all(axis=1)
        distance = np.median(depth[seen])
        after, further = moved.project(scene.points)
        assert np.allclose(further, depth + factor * distance)
        rows, columns = part
        assert columns.stop - columns.start == pytest.approx(size[0] / (1 + factor), abs=2)
        assert rows.stop - rows.start == pytest.approx(size[1] / (1 + factor), abs=2)
        at_it = seen & (abs(depth - distance) < 0.02 * distance)
        inside = (after[at_it] >= (columns.start - 1, rows.start - 1)).all(axis=1) & (
            after[at_it] < (columns.stop + 1, rows.stop + 1)).all(axis=1)
        assert at_it.sum() > 5 and inside.all()


def test_a_view_that_sees_no_points_cannot_move_away(scene):
    camera = scene.views[0].camera
    turned = replace(camera, rotation=np.diag([1, -1, -1.0]) @ camera.rotation,
                     translation=np.diag([1, -1, -1.0]) @ camera.translation)
    with pytest.raises(InputError, match="^--away: a view sees none of the sparse points, .*; "):
        moved_away(turned, scene.points, 1)


@pytest.mark.slow
def test_a_near_view_is_the_full_model_and_a_far_one_is_less(item_device, run):
    near = next(compare_views(run.path, None, item_device, bias=1e-6))
    assert near["share"] == 1 and near["psnr_full"] > 100
    assert near["psnr"] == pytest.approx(near["full_psnr"], abs=1e-4)
    far = next(compare_views(run.path, None, item_device, away=30))
    coarse = read_ply(run.snapshots()[0][1])
    assert far["gaussians"] == coarse.count and far["share"] < 1
    assert np.isfinite(far["psnr_full"]) and far["seconds"] > 0 and far["full_seconds"] > 0


@pytest.mark.slow
def test_what_is_told_is_what_the_pictures_show(item_device, run, capsys):
    told = next(compare_views(run.path, None, item_device, bias=1e6, downscale=2))
    gaussians, scene, options = to_render(run.path, None)
    scene = scene.reduced(2)
    view = scene.split(options.test_every)[1][0]
    drawn = Detail(Run(run), scene, item_device, 1e6).draw(view.camera)
    full = render_view(*opened(item_device, gaussians, scene, options), view.camera)
    for key, pair in (("psnr_full", (drawn, full)), ("psnr", (drawn, photo_of(view))),
                      ("full_psnr", (full, photo_of(view)))):
        assert told[key] == pytest.approx(psnr(*pair), abs=1e-6), key
    assert told["psnr"] < told["full_psnr"] - 0.1 and told["share"] < 1
    main([str(run.path), "-r", str(2), "--bias", "1e6", "--device", item_device.name])
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split()[0] == "view" and lines[-1].split()[0] == "mean"
    assert f"{told['psnr']:.2f}" in lines[1].split()


@pytest.mark.slow
def test_supersampling_is_the_mean_of_the_pixels_in_a_pixel(item_device, scene, run):
    small = scene.reduced(4)
    model, camera = Run(run).opened(item_device, small), small.views[0].camera
    image = supersampled(model, camera, 2)
    large = render_view(*model, camera.resized(2 * camera.width, 2 * camera.height))
    quarters = [large[i::2, j::2] for i in (0, 1) for j in (0, 1)]
    assert np.allclose(image, sum(quarters) / 4, atol=1e-6)
    assert not np.allclose(image, quarters[0], atol=1e-3)


@pytest.mark.slow
def test_far_views_take_few_gaussians_and_lose_nothing(scene, tmp_path, item_device):
    """The figure of issue 5: at most 30 % of the gaussians, at most 0.2 dB worse against photos."""
    run = RunFolder.create(tmp_path / "run")
    train(scene, resolve({}, {"iterations": 1500, "snapshots": True}), item_device, run)
    records = list(compare_views(run.path, None, item_device, downscale=8))
    share, lod_psnr, full_psnr = (np.mean([record[key] for record in records])
                                  for key in ("share", "psnr", "full_psnr"))
    assert share <= 0.3 and lod_psnr >= full_psnr - 0.2, (share, lod_psnr, full_psnr)
