"""A scene folder in map coordinates: whole or not at all, wherever it is written."""

import numpy as np
import pycolmap
import pytest

from clsplat.errors import InputError
from clsplat.io.georeference.scene_folder import georeference_scene
from clsplat.io.scenes.read import read_scene
from tests.data.survey import CRS, Survey
from tests.io.photos.test_metadata import photo


@pytest.fixture
def survey(tmp_path):
    """A scene without a place, whose photos have GPS."""
    survey = Survey(tmp_path / "scene")
    (tmp_path / "scene" / "images").mkdir()
    for name, known in survey.metadata().items():
        photo(
            tmp_path / "scene" / "images" / name,
            {
                "GPS:LatitudeRef": "N",
                "GPS:Latitude": (known.latitude, 0.0, 0.0),
                "GPS:LongitudeRef": "W",
                "GPS:Longitude": (-known.longitude, 0.0, 0.0),
                "GPS:AltitudeRef": 0,
                "GPS:Altitude": known.altitude,
            },
        )
    return survey


def test_a_scene_folder_is_georeferenced(tmp_path, survey):
    placed = georeference_scene(tmp_path / "scene", tmp_path / "out")
    scene = read_scene(tmp_path / "out")
    assert scene.georeference == placed.georeference and scene.georeference.crs == CRS
    places = scene.georeference.to_map([view.camera.position + scene.offset for view in scene.views])
    assert np.abs(places - survey.centres).max() < 3  # EXIF's numbers have 7 digits here
    assert len(scene.observations) == len(survey.scene.observations)
    with pytest.raises(InputError, match="out: exists already"):
        georeference_scene(tmp_path / "scene", tmp_path / "out")
    with pytest.raises(InputError, match="no photo has GPS; give photos with GPS"):
        georeference_scene(tmp_path / "scene", tmp_path / "other", photos=tmp_path)
    assert not (tmp_path / "other").exists() and not (tmp_path / "other.part").exists()


def test_photos_of_a_wide_lens_have_gps(tmp_path, survey):
    """Each becomes several views, of other names."""
    reconstruction = survey.reconstruction()
    for camera in reconstruction.cameras.values():
        camera.model = pycolmap.CameraModelId.OPENCV_FISHEYE
        camera.params = [20.0, 20.0, 32.0, 24.0, 0.0, 0.0, 0.0, 0.0]
    reconstruction.write(survey.folder / "sparse" / "0")
    placed = georeference_scene(survey.folder, tmp_path / "out")
    assert placed.georeference.source == "GPS of 12 photos"


def test_the_new_folder_may_be_in_that_of_the_scene(tmp_path, survey):
    georeference_scene(survey.folder, survey.folder / "utm")
    assert {path.name for path in survey.folder.iterdir()} == {"images", "sparse", "utm"}
    assert {path.name for path in (survey.folder / "utm").iterdir()} == {
        "images",
        "sparse",
        "georeference.json",
        "orientation.json",
    }


def test_a_full_disk_leaves_nothing(tmp_path, survey):
    """pycolmap cuts its files short and says nothing."""
    resource = pytest.importorskip("resource")
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8192, limit[1]))
    try:
        with pytest.raises(InputError, match=r"points3D.bin: not written whole.*free some"):
            georeference_scene(survey.folder, tmp_path / "out")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]
