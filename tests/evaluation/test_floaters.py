"""Floaters: which gaussians count, by how much, and where the ground truth is looked for."""

import shutil

import numpy as np
import pytest

from clsplat.cli.evaluate import summary
from clsplat.errors import InputError
from clsplat.evaluation import floaters, views
from clsplat.evaluation.floaters import floater_share, ground_truth
from clsplat.evaluation.run import Run
from clsplat.gaussians import Gaussians
from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.read import read_scene
from clsplat.synth.cameras import looking, survey
from clsplat.synth.geometry import City, distance, save
from clsplat.synth.layout import city as lay_out
from tests.data.gaussians_at import gaussians_at
from tests.data.tiny_model import write_scene
from tests.data.tiny_training import CITY, options_of

NOTHING = np.zeros(3)


@pytest.fixture
def plane():
    """The ground and nothing else."""
    return City(0, (1, 1), np.zeros((1, 1), bool), np.zeros((0, 2, 3)), np.zeros(0, int),
                np.zeros((0, 4)))


def down(x, height, width=200):
    """A camera that looks straight down and 30 degrees to each side, at y = 0."""
    return looking(np.array([x, 0, height], float), np.array([0, 0, -1.0]), np.array([0, 1.0, 0]),
                   width, 200)


def gaussians(positions, opacity=0.5):
    opacity = np.broadcast_to(np.asarray(opacity, float), len(positions))
    return gaussians_at(positions, opacity_logits=np.log(opacity / (1 - opacity)))


def shares(*arguments):
    return tuple(round(share, 6) for share in floater_share(*arguments).values())


def test_the_closest_camera_that_sees_decides(plane):
    near, far = down(0, 10), down(0, 1000)
    height = 0.5 * 1000 / far.focal[0]  # half a pixel for one camera, some fifty for the other
    model = gaussians([[0, 0, height]])
    assert shares(plane, model, [far], NOTHING) == (0, 0, 0)
    assert shares(plane, model, [near, far], NOTHING) == (1, 1, 1)
    assert shares(plane, model, [far, near], NOTHING) == (1, 1, 1)
    aside = gaussians([[100, 0, height]])  # the lower camera is nearer but does not see it
    assert shares(plane, aside, [near, far], NOTHING) == (0, 0, 0)
    behind = gaussians([[0, 0, 11], [0, 0, 11]])  # above the lower camera, in the higher's image
    assert shares(plane, behind, [near, far], NOTHING) == (1, 0, 0)  # 1.9 of its pixels


@pytest.mark.slow
def test_leaving_out_solids_and_cameras_changes_nothing(monkeypatch):
    city = lay_out((2, 2), 1)
    cameras = survey(city, 20, 64, 48)
    rng = np.random.default_rng(0)
    positions = np.concatenate([rng.uniform((-30, -30, -2), (30, 30, 12), (3000, 3)),
                                rng.uniform(-200, 200, (300, 3))]).astype(np.float32)
    model = gaussians(positions, rng.uniform(0.01, 0.9, len(positions)))
    footprint = np.full(len(positions), np.inf)
    for camera in cameras:
        pixels, depth = camera.project(positions)
        sees = (depth > 0) & (pixels >= 0).all(axis=1) & (pixels <= (64, 48)).all(axis=1)
        footprint[sees] = np.minimum(footprint[sees], depth[sees] / camera.focal[0])
    reach = np.min([np.linalg.norm(positions - c.position, axis=1) for c in cameras], axis=0)
    footprint = np.where(np.isinf(footprint), reach / cameras[0].focal[0], footprint)
    opacity = 1 / (1 + np.exp(-model.opacity_logits.astype(float)))
    away = distance(city, positions)
    expected = [opacity @ (away > k * footprint) / opacity.sum() for k in floaters.TOLERANCES]
    assert 0.05 < expected[2] < expected[0] < 0.95
    for chunk in (50, 100_000):
        monkeypatch.setattr(floaters, "CHUNK", chunk)
        assert list(floater_share(city, model, cameras, NOTHING).values()) == pytest.approx(
            expected, abs=1e-9)


@pytest.fixture(scope="module")
def sample():
    return read_scene(CITY)


def test_the_sample_city_sparse_points_do_not_float(sample):
    model = Gaussians.from_points(sample.points, sample.colours)
    cameras = [view.camera for view in sample.views]
    city = ground_truth(sample.path)
    assert max(shares(city, model, cameras, sample.offset)) < 0.02
    model.rows["positions"][:] += np.float32([0, 0, 8])
    assert min(shares(city, model, cameras, sample.offset)) > 0.5


def test_where_the_ground_truth_lies(tmp_path, plane):
    assert len(ground_truth(CITY).boxes) > 100
    folder = write_scene(tmp_path / "town")
    assert ground_truth(folder) is None
    save(plane, folder / "geometry.json")
    assert ground_truth(folder).blocks == (1, 1)
    (tmp_path / "geometry.json").write_text("{}")
    with pytest.raises(InputError, match="geometry.json"):
        ground_truth(tmp_path)


@pytest.mark.slow
def test_evaluations_tell_floaters_where_the_truth_is_known(tmp_path, sample, monkeypatch):
    monkeypatch.setattr(Run, "opened", lambda *_: (None, None, 0))
    monkeypatch.setattr(views, "evaluate_views", lambda *_, **__: {"psnr": 20.0, "per_view": []})
    model = Gaussians.from_points(sample.points, sample.colours, 0)
    lift = np.random.default_rng(0).exponential(5, model.count)  # from none to many pixels
    model.rows["positions"][:, 2] += lift.astype(np.float32)
    elsewhere = tmp_path / "plain"
    shutil.copytree(CITY, elsewhere, ignore=shutil.ignore_patterns("geometry.json"))
    results = []
    for scene in (CITY, elsewhere):
        run = RunFolder.create(tmp_path / f"run_{scene.name}")
        run.write_options({**vars(options_of(sh_degree=0)), "scene": scene})
        run.save_model(model, sample.offset)
        results.append(views.evaluate_run(Run(run), None, save_images=False))
    cameras = [view.camera for view in sample.reduced(8).split(8)[0]]
    expected = floater_share(ground_truth(CITY), model, cameras, sample.offset)
    assert 0 < expected["floaters_10"] < expected["floaters_3"] < expected["floaters"] < 1
    for result in results:
        del result["pictures"], result["per_view"]
    assert results == [{"psnr": 20.0, **expected}, {"psnr": 20.0}]


def test_the_summary_has_floaters_only_if_known():
    scores = {"views": 3, "psnr": 20, "ssim": 0.5, "psnr_cc": 25, "ssim_cc": 0.75}
    assert "floaters" not in summary(scores)
    text = summary({**scores, "floaters": 0.25, "floaters_3": 0.05, "floaters_10": 0.00125})
    rows = [line.split() for line in text.splitlines()]
    assert rows[-2:] == [["pixels", "off", ">", "1", ">", "3", ">", "10"],
                         ["floaters", "25.00%", "5.00%", "0.12%"]]
