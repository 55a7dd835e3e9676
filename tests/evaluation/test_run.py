"""The object of a run: its options, scene and renderer in one place, and what it refuses."""

import dataclasses
import shutil

import numpy as np
import pytest
from click.testing import CliRunner

from clsplat.cli.main import main
from clsplat.errors import InputError
from clsplat.evaluation.run import Run, to_render
from clsplat.evaluation.views import render_view
from clsplat.gaussians import Gaussians
from clsplat.io.images import read_image
from clsplat.io.ply import write_ply
from clsplat.io.run import RunFolder
from clsplat.io.scenes import fingerprint, read_scene
from clsplat.options import resolve
from tests.data.tiny_training import CITY

OPTIONS = {"downscale": 8.0, "background": (0.3, 0.2, 0.1), "near": 2.0, "test_every": 16}


@pytest.fixture(scope="module")
def scene():
    return read_scene(CITY)


@pytest.fixture
def run(tmp_path, scene):
    """A finished run of gaussians on the sparse points."""
    folder = RunFolder.create(tmp_path / "run")
    folder.write_options({"scene": CITY, "fingerprint": fingerprint(scene),
                          **dataclasses.asdict(resolve({}, OPTIONS))})
    folder.save_model(Gaussians.from_points(scene.points, scene.colours, 1), scene.offset)
    return Run.open(folder.path)


def test_the_scene_is_as_it_was_trained_on(run, scene):
    assert run.options == resolve({}, OPTIONS) and run.record["fingerprint"] == fingerprint(scene)
    assert run.metrics == [] and run.exposures is None and not run.is_finished
    camera, whole = run.scene().views[0].camera, scene.views[0].camera
    assert (camera.width, camera.height) == (whole.width // 8, whole.height // 8)
    assert run.scene(whole=True).views[0].camera.width == whole.width


def test_another_scene_is_refused(run, tmp_path):
    shutil.copytree(CITY, tmp_path / "other")
    points = tmp_path / "other/sparse/0/points3D.bin"
    data = bytearray(points.read_bytes())
    data[16:24] = np.float64(7.5).tobytes()  # x of the first point
    points.write_bytes(data)
    with pytest.raises(InputError, match="other: is not the scene that .* was trained on"):
        run.scene(tmp_path / "other")
    _, shown, _ = to_render(run.path, tmp_path / "other")  # cameras may be those of any scene
    assert shown.path == tmp_path / "other"


def test_the_near_plane_is_asked_for_in_the_units_of_the_original(scene):
    unit = scene.normalised()
    assert scene.near(0) == scene.near_plane and scene.near(2.0) == 2.0
    assert unit.near(0) == unit.near_plane and unit.near(2.0) == pytest.approx(2 / scene.extent)


def test_a_renderer_draws_as_the_run_was_trained(run, scene, item_device):
    small = run.scene()
    renderer, rows, degree = run.opened(item_device, small)
    assert degree == 1 and renderer.near == 2.0
    empty = run.finished_model.scaled(1e-6)  # too small to cover anything but the background
    empty.rows["opacity_logits"][:] = -30
    image = render_view(*run.opened(item_device, small, empty), small.views[0].camera)
    assert np.allclose(image, OPTIONS["background"], atol=1e-3)


def test_pictures_of_a_run_and_of_its_model(run, tmp_path, scene, item_device):
    def rendered(path, *words):
        out = tmp_path / f"out {len(list(tmp_path.iterdir()))}"
        result = CliRunner().invoke(main, ["render", str(path), "-o", str(out), "--device",
                                           item_device.name, *map(str, words)])
        return result, out

    result, out = rendered(run.path, "--views", "test")
    test = scene.reduced(8).split(16)[1]
    assert result.output == f"{len(test)} pictures: {out}\n"
    names = {path.relative_to(out).as_posix() for path in out.rglob("*.png")}
    assert names == {f"{view.name}.png" for view in test}
    picture = read_image(out / f"{test[0].name}.png")
    drawn = render_view(*run.opened(item_device, run.scene()), test[0].camera)
    assert abs(picture / 255 - drawn).max() <= 0.5 / 255 + 1e-6
    result, out = rendered(run.folder.model_path, "--views", "test")
    assert result.exit_code == 2 and "point_cloud.ply: a PLY file has no cameras" in result.output
    run.folder.write_options({**run.record, "test_every": 0, "scene": CITY})
    result, out = rendered(run.path, "--views", "test")
    assert result.exit_code == 2 and "no test views; choose others with --views" in result.output
    _, shown, options = to_render(run.folder.model_path, CITY)
    assert shown.views[0].camera.width == scene.views[0].camera.width and options.near == 0


def test_nothing_to_show_or_not_finished(run, tmp_path, item_device):
    rows = {name: values[:0] for name, values in run.finished_model.rows.items()}
    write_ply(run.folder.model_path, Gaussians(rows, 1))
    with pytest.raises(InputError, match="run: holds no gaussians"):
        run.opened(item_device, run.scene())
    run.folder.model_path.unlink()
    with pytest.raises(InputError, match="the run has no model yet; finish it with --resume"):
        run.opened(item_device, run.scene())
    with pytest.raises(InputError, match="holds no run"):
        Run.open(tmp_path)
