"""Small inputs of public reports (../shared/cases), each with what is right."""

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.io.models.formats import read_model
from clsplat.io.scenes.read import read_scene
from clsplat.sfm.photos import find_photos
from tests.io.shared_cases import CASES, needs_cases

pytestmark = needs_cases


@pytest.mark.parametrize("name", ["photos_odm_mask", "photos_realityscan_mask",
                                  "photos_masks_folder_same_name"])
def test_masks_beside_photos(name):
    photos, refused = find_photos(CASES / name)
    assert [photo.name for photo in photos] == [f"DJI_000{n}.JPG" for n in range(6)]
    assert all(photo.mask is not None and photo.name[:8] in photo.mask.name for photo in photos)
    assert refused == {}


@pytest.mark.parametrize("name, count", [
    ("ply/inf_opacity.ply", 50), ("ply/neginf_scale.ply", 50), ("ply/nan2.ply", 48),
    ("sog2_dir.sog", 50)])
def test_models(name, count):
    model = read_model(CASES / name)
    assert model.count == count
    assert all(np.isfinite(rows).all() for rows in model.rows.values())


@pytest.mark.parametrize("read, name, words", [
    (read_model, "sog1.sog", "version 1"), (read_scene, "transforms_opencv_k4", "coefficient k4"),
    (read_scene, "images_txt_one_line_each", "images.txt")])
def test_what_cannot_be_read_is_refused_by_name(read, name, words):
    with pytest.raises(InputError, match=words):
        read(CASES / name)


def test_the_angle_of_a_frame():
    for view in read_scene(CASES / "transforms_frame_angle").views:
        assert view.camera.focal == pytest.approx(2 * (160 / np.tan(np.pi / 6),))
