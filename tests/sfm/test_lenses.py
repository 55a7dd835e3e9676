"""Lenses that cannot be true are named."""

import pycolmap
import pytest

from clsplat.sfm.lenses import lens_doubts
from clsplat.sfm.photos import SourceCamera

SOURCE = SourceCamera("OPENCV", 4000, 3000, 3600.0, True, None, tuple(range(9)))


def doubts(model, params, source=SOURCE):
    result = pycolmap.Reconstruction()
    result.add_camera(pycolmap.Camera(camera_id=1, model=model, width=4000, height=3000, params=params))
    return lens_doubts(result, [source])


@pytest.mark.parametrize(
    "model, params",
    [
        ("OPENCV", [3650, 3640, 2010, 1490, -0.1, 0.05, 1e-3, 1e-3]),
        ("SIMPLE_RADIAL", [3300, 2000, 1500, 0.05]),
        ("PINHOLE", [3600, 3600, 2000, 1500]),
        ("OPENCV_FISHEYE", [3600, 3600, 2000, 1500, 0.01, 0, 0, 0]),
    ],
)
def test_lenses_that_can_be_true(model, params):
    assert doubts(model, params) == []


@pytest.mark.parametrize(
    "params, words",
    [
        ([4300, 4300, 2000, 1500, 0], "the focal length of 4300 pixels is +19 % from the 3600 of"),
        ([3600, 3600, 2250, 1500, 0], "the principal point is 250 pixels from where it is expected"),
        ([3600, 3600, 2000, 1500, -0.8], "its distortion folds the corners of the photos inwards"),
        ([3600, 3600, 2000, 1500, 0.8], "its distortion moves the corners of the photos by +39 %"),
    ],
)
def test_lenses_that_cannot(params, words):
    (found,) = doubts("OPENCV", [*params, 0, 0, 0])
    assert found.startswith("camera 1 (9 photos of 4000x3000): " + words)
    assert "--camera-model" in found


def test_what_is_not_known_is_no_measure():
    unknown = SourceCamera("OPENCV", 4000, 3000, 4800.0, False, None, (0, 1, 2))
    assert doubts("PINHOLE", [3600, 3600, 2000, 1500], unknown) == []
    moved = SourceCamera("OPENCV", 4000, 3000, 3600.0, True, (3600, 3600, 2260, 1500, 0, 0, 0, 0), (0, 1, 2))
    assert doubts("PINHOLE", [3600, 3600, 2250, 1500], moved) == []
