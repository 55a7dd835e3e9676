"""Matched photos get poses; what is damaged or falls apart is told."""

import shutil

import numpy as np
import pycolmap
import pytest

from clsplat.sfm import mapping
from clsplat.sfm.features import create_database
from clsplat.sfm.mapping import _square, _use_square_pixels, map_photos
from clsplat.sfm.photos import cameras_of
from clsplat.sfm.reconstruct import reasons
from tests.sfm.cases import Lines, source, synthetic


def test_a_known_scene_is_found_again(tmp_path):
    truth = synthetic(tmp_path / "d.db")
    progress = Lines()
    model = map_photos(tmp_path / "d.db", cameras_of([source()]), 6, progress)
    steps = [f"global mapping, adjustment {number}" for number in range(1, 7)]
    assert progress.phases == [
        "global mapping",
        *steps,
        "global mapping, without lens distortion",
        "triangulation",
        "bundle adjustment",
    ]
    assert model.cameras[1].params[3] == pytest.approx(0.05, abs=1e-3)
    assert model.num_reg_images() == 6 and model.compute_mean_reprojection_error() < 0.1
    assert model.num_points3D() > 50
    true, found = (
        np.array([image.projection_center() for _, image in sorted(dict(scene.images).items())])
        for scene in (truth, model)
    )
    distances = [np.linalg.norm(places[:, None] - places, axis=2)[np.triu_indices(6, 1)] for places in (true, found)]
    ratios = distances[0] / distances[1]
    assert ratios.std() < 0.01 * ratios.mean()


def test_a_killed_command_goes_on_from_the_last_stage(tmp_path, monkeypatch):
    synthetic(tmp_path / "d.db")
    whole = map_photos(tmp_path / "d.db", cameras_of([source()]), 6, Lines())
    monkeypatch.setattr(mapping, "_global", None)
    triangulated = mapping._triangulated
    monkeypatch.setattr(mapping, "_triangulated", None)
    again = map_photos(tmp_path / "d.db", cameras_of([source()]), 6, Lines())
    assert again.summary() == whole.summary()
    monkeypatch.setattr(mapping, "_triangulated", triangulated)
    shutil.rmtree(tmp_path / "triangulated")
    again = map_photos(tmp_path / "d.db", cameras_of([source()]), 6, Lines())
    assert again.num_points3D() == whole.num_points3D()


@pytest.mark.parametrize("distortion, model", [(0.0, "SIMPLE_PINHOLE"), (0.2, "SIMPLE_RADIAL")])
def test_distortion_that_photos_do_not_have_is_left_out(tmp_path, distortion, model):
    synthetic(tmp_path / "d.db", points=300, distortion=distortion)
    noisy = synthetic(points=300, distortion=distortion)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev = 0.5
    pycolmap.synthesize_noise(noise, noisy)
    mapping._adjust(noisy, False)
    assert noisy.cameras[1].params[3] != 0
    found = mapping._without_distortion(noisy, tmp_path / "d.db", Lines())
    assert found.cameras[1].model_name == model
    with pycolmap.Database.open(tmp_path / "d.db") as database:
        assert database.read_camera(1).model_name == model


def test_the_attempt_that_fits_best_is_taken_and_a_chosen_model_stays(tmp_path, monkeypatch):
    models = [synthetic(distortion=0.0) for _ in range(3)]
    for shift, model in zip((0.3, 0.1, 0.2), models):
        for image in model.images.values():
            for point in image.points2D:
                point.xy = point.xy + shift
        model.update_point_3d_errors()
    monkeypatch.setattr(mapping, "_global", lambda database, fixed, attempts, progress: models[:attempts])
    cameras = cameras_of([source()], "SIMPLE_RADIAL")
    assert mapping._placed(tmp_path / "d.db", cameras, False, Lines()) is models[1]
    monkeypatch.setattr(mapping, "FEW_PHOTOS", 0)
    assert mapping._placed(tmp_path / "d.db", cameras, False, Lines()) is models[0]


def test_each_attempt_begins_with_the_matches_and_a_seed_of_its_own(tmp_path, monkeypatch):
    synthetic(tmp_path / "d.db")
    before, seeds, pipeline = (tmp_path / "d.db").read_bytes(), [], pycolmap.GlobalPipeline
    monkeypatch.setattr(
        pycolmap,
        "GlobalPipeline",
        lambda options, *given: (seeds.append(options.random_seed), pipeline(options, *given))[1],
    )
    assert len(mapping._global(tmp_path / "d.db", False, 2, Lines())) == 2
    assert seeds == [0, 1] and (tmp_path / "d.db").read_bytes() == before


def test_incremental_mapping_follows_what_does_not_register_all(tmp_path, monkeypatch):
    synthetic(tmp_path / "d.db")
    monkeypatch.setattr(mapping, "_global", lambda *_: [])
    progress = Lines()
    model = map_photos(tmp_path / "d.db", cameras_of([source()]), 6, progress)
    assert model.num_reg_images() == 6
    assert progress.counts[0] == ("incremental mapping, photo", 3, 6)


def test_reasons_name_what_is_missing(tmp_path):
    synthetic(tmp_path / "d.db", photos=3)
    photos = [source(f"{index}.jpg") for index in range(3)]
    why = reasons(tmp_path / "d.db", photos, {"0.jpg"})
    assert set(why) == {"1.jpg", "2.jpg"} and "only 70 features" in why["2.jpg"]


def test_cameras_whose_pixels_are_not_square_get_a_simpler_model(tmp_path):
    model = synthetic()
    assert _square(model)
    model.cameras[1] = pycolmap.Camera(
        model="OPENCV", width=320, height=240, camera_id=1, params=[400, 300, 160, 120, 0, 0, 0, 0]
    )
    assert not _square(model)
    cameras = cameras_of([source(f"{index}.jpg") for index in range(8)])
    create_database(tmp_path / "d.db", cameras)
    _use_square_pixels(tmp_path / "d.db", cameras)
    with pycolmap.Database.open(tmp_path / "d.db") as database:
        camera = database.read_camera(1)
    assert camera.model_name == "RADIAL" and camera.focal_length == pytest.approx(1.2 * 64)
