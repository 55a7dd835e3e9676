"""transforms.json of other programs and hands: each value is used rightly or refused by name."""

import shutil

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.io.photos.lenses import pixel_map
from clsplat.io.scenes import transforms
from clsplat.io.scenes.read import read_scene
from tests.data.layouts import every_fourth, write_transforms
from tests.io.scenes.test_transforms import CITY, changed, first
from tests.io.shared_cases import CASES, needs_cases


@pytest.fixture(scope="module")
def city():
    return every_fourth(read_scene(CITY))


@needs_cases
def test_case_opencv_k4(tmp_path):
    """nerfstudio's k4 is the factor of r^8: places appear at 1 - 0.3 r^8 times their distance."""
    scene = read_scene(shutil.copytree(CASES / "transforms_opencv_k4", tmp_path / "scene"))
    for view in scene.views:
        lens, focal = view.lens, 277.1281292110204
        x, y = np.meshgrid(*(
            (np.arange(side) + 0.5 - centre) / length for side, centre, length in zip(
                (lens.width, lens.height), lens.centre, lens.focal)))
        radial = 1 - 0.3 * (x**2 + y**2) ** 4
        found = pixel_map(lens)
        shown = np.isfinite(found[0])
        assert shown.mean() > 0.95
        for known, place, middle in zip(found, (x, y), (160, 120)):
            np.testing.assert_allclose(known[shown], (focal * place * radial + middle)[shown],
                                       atol=1e-3)


@needs_cases
def test_case_frame_angle(tmp_path):
    scene = read_scene(shutil.copytree(CASES / "transforms_frame_angle", tmp_path / "scene"))
    for view in scene.views:
        assert view.camera.focal == pytest.approx(2 * (160 / np.tan(np.pi / 6),))


FOCAL = (80.0, 60.0)


@pytest.mark.parametrize("table, frame, focal", [
    ({"fl_x": 1, "fl_y": 2}, {"camera_angle_x": 1.0}, (146.44, 146.44)),
    ({"fl_x": 1, "fl_y": 2}, {"fl_x": 80}, (80, 80)),
    ({"fl_x": 1, "fl_y": 2}, {"fl_y": 60}, (1, 60)),
    ({"fl_y": 60}, {"fl_x": 80}, FOCAL), ({"fl_x": 80}, {"fl_y": 60}, FOCAL),
    ({"camera_angle_x": 0.1}, {"fl_x": 80}, (80, 80)),
    ({"camera_angle_x": 0.1, "fl_y": 5}, {"fl_x": 80, "fl_y": 60}, FOCAL),
    ({"fl_x": 80, "fl_y": 60}, {}, FOCAL),
    ({"camera_angle_x": 0.1, "camera_angle_y": 0.1}, {"camera_angle_x": 1.0}, (146.44, 146.44)),
])
def test_the_focal_length_of_a_frame_beats_that_of_the_table(table, frame, focal):
    own = transforms._own(table, frame)
    assert (transforms._focal(own, *transforms.FOCAL_X, 160), transforms._focal(
        own, *transforms.FOCAL_Y, 120, transforms._focal(own, *transforms.FOCAL_X, 160))
            ) == pytest.approx(focal, abs=0.01)


@pytest.mark.parametrize("table, frame, model", [
    ({"k1": 0.1}, {}, "OPENCV"), ({"k1": 0.1}, {"k1": 0}, None), ({}, {"k1": 0.1}, "OPENCV"),
    ({"k4": -0.1}, {}, "BROWN_K4"),
    ({"k4": -0.1, "camera_model": "FULL_OPENCV"}, {}, "FULL_OPENCV"),
    ({"k4": -0.1, "is_fisheye": True}, {}, "OPENCV_FISHEYE"),
    ({"k4": -0.1, "is_fisheye": True}, {"camera_model": "OPENCV"}, None),
    ({"camera_model": "OPENCV_FISHEYE"}, {"camera_model": "PINHOLE"}, None),
    ({"camera_model": "PINHOLE"}, {"is_fisheye": True}, "OPENCV_FISHEYE"),
    ({"k5": 0.1}, {}, "OPENCV has no coefficient k5"), ({"k6": 0.1}, {"is_fisheye": True}, None),
    ({"is_fisheye": True, "k5": 0.1}, {}, "OPENCV_FISHEYE has no coefficient k5"),
    ({"is_fisheye": True}, {"p1": 0.1}, "OPENCV_FISHEYE has no coefficient p1"),
    ({"k6": 0.1, "camera_model": "FULL_OPENCV"}, {}, "FULL_OPENCV"),
    ({"ftheta_p0": 0.1}, {}, "F-theta"), ({"k1": "a"}, {}, "k1 is not a number"),
])
def test_each_coefficient_is_used_or_refused(table, frame, model):
    own = transforms._own(table, frame)
    if frame == {"is_fisheye": True}:
        model = "OPENCV_FISHEYE"
    if model and " " in model or model == "F-theta":
        with pytest.raises(ValueError, match=model):
            transforms._lens(own, (160, 120), (100.0, 100.0, 80.0, 60.0))
        return
    lens = transforms._lens(own, (160, 120), (100.0, 100.0, 80.0, 60.0))
    assert (lens and lens[0]) == model


@pytest.mark.parametrize("change, words", [
    (lambda m: np.transpose(m), "is it transposed"), (lambda m: np.multiply(m, 2), "not 0 0 0 1"),
    (lambda m: m[:3], ""), (lambda m: [*m[:3], [0, 0, 0, None]], "not 0 0 0 1"),
    (lambda m: [*m[:3], [0, 0, 1e99, 1]], "not 0 0 0 1"), (lambda m: m[:2], "3x4 or 4x4"),
    (lambda m: np.ravel(m), "3x4 or 4x4")])
def test_matrices_that_are_no_pose(tmp_path, city, change, words):
    table = write_transforms(tmp_path, city)
    matrix = table["frames"][0]["transform_matrix"]
    folder = changed(tmp_path, table, **first(transform_matrix=np.array(
        change(np.array(matrix))).tolist())(table))
    if not words:
        assert read_scene(folder).views
        return
    with pytest.raises(InputError, match=f"frame 0 is damaged .*{words}"):
        read_scene(folder)
