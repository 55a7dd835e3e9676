"""The response of a photo: gain and transform, whatever part and size of the photo is rendered."""

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.io.runs.run import read_exposures, write_exposures
from clsplat.response import Lenses, Response, corner_radius, lens_kind

CAMERA = Camera(80, 60, (70, 75), (43, 28), np.eye(3), np.zeros(3))
LENS = np.array([-0.3, 0.2, -0.1, 1 / corner_radius(CAMERA)])


@pytest.mark.slow
def test_gain_is_one_on_the_axis_and_ends_in_the_farthest_corner():
    gain = Response(vignetting=LENS).gain(CAMERA)
    assert gain[27, 42] == pytest.approx(1, abs=1e-4)  # half a pixel off the axis
    wide = Response(vignetting=LENS).gain(CAMERA.resized(4000, 3000))
    assert wide[-1, 0] == pytest.approx(1 + LENS[:3].sum(), abs=1e-3)  # the axis is right and up


def test_a_part_of_a_photo_has_the_gain_of_that_part():
    gain = Response(vignetting=LENS).gain(CAMERA)
    part = CAMERA.cropped(10, 20, 50, 55)
    assert np.allclose(Response(vignetting=LENS).gain(part), gain[20:55, 10:50])
    assert corner_radius(part) == pytest.approx(corner_radius(CAMERA))
    assert lens_kind(part) == lens_kind(CAMERA) == lens_kind(CAMERA.reduced(2))


def test_the_gain_comes_before_the_transform():
    response = Response(np.column_stack([2 * np.eye(3), [0.1, 0.2, 0.3]]), LENS)
    image = np.random.default_rng(0).random((60, 80, 3))
    expected = 2 * image * response.gain(CAMERA)[:, :, None] + [0.1, 0.2, 0.3]
    assert response.has_vignetting and np.allclose(response.applied(image, CAMERA), expected)
    plain = Response(response.transform)
    assert not plain.has_vignetting
    assert np.allclose(plain.applied(image, CAMERA), 2 * image + [0.1, 0.2, 0.3])


def test_photos_of_one_shape_and_focal_length_share_a_lens():
    other = CAMERA.resized(60, 80)
    near = Camera(80, 60, (70.2, 75), (40, 30), np.eye(3), np.zeros(3))
    lenses = Lenses.of_cameras([CAMERA, other, near, CAMERA.reduced(2)])
    assert lenses.of.tolist() == [0, 1, 0, 0] and not lenses.rows[:, :3].any()
    assert lenses.rows[0, 3] == pytest.approx(
        1 / max(corner_radius(camera) for camera in (CAMERA, near, CAMERA.reduced(2)))
    )


def test_files_keep_responses_to_the_last_digit(tmp_path):
    rng = np.random.default_rng(1)
    written = {
        "a": Response(rng.normal(size=(3, 4))),
        "b": Response(rng.normal(size=(3, 4)), LENS),
        "c": Response(vignetting=LENS),
    }
    write_exposures(tmp_path, written)
    read = read_exposures(tmp_path)
    for name, response in written.items():
        assert np.array_equal(read[name].transform, response.transform)
        assert np.array_equal(read[name].vignetting, response.vignetting)
        assert read[name].has_vignetting == response.has_vignetting
