"""Matched photos get poses; what is damaged or falls apart is told."""

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
    assert progress.phases == ["global mapping", "triangulation", "bundle adjustment"]
    assert model.num_reg_images() == 6 and model.compute_mean_reprojection_error() < 0.1
    assert model.num_points3D() > 50
    true, found = (np.array([image.projection_center() for _, image in sorted(
        dict(scene.images).items())]) for scene in (truth, model))
    distances = [np.linalg.norm(places[:, None] - places, axis=2)[np.triu_indices(6, 1)]
                 for places in (true, found)]
    ratios = distances[0] / distances[1]
    assert ratios.std() < 0.01 * ratios.mean()


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
    model.cameras[1] = pycolmap.Camera(model="OPENCV", width=320, height=240, camera_id=1,
                                       params=[400, 300, 160, 120, 0, 0, 0, 0])
    assert not _square(model)
    cameras = cameras_of([source(f"{index}.jpg") for index in range(8)])
    create_database(tmp_path / "d.db", cameras)
    _use_square_pixels(tmp_path / "d.db", cameras)
    with pycolmap.Database.open(tmp_path / "d.db") as database:
        camera = database.read_camera(1)
    assert camera.model_name == "RADIAL" and camera.focal_length == pytest.approx(1.2 * 64)
