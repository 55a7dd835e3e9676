"""Small inputs of public reports (../shared/cases/README.md), each with what must hold for it."""

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.io.models.formats import read_model
from clsplat.io.scenes.read import read_scene
from clsplat.sfm.photos import find_photos
from tests.io.shared_cases import CASES, needs_cases

pytestmark = needs_cases
# gcp and exif_* are in cli/test_georeference.py, photos_thermal_16bit in photos/test_levels.py
HOLDS = [
    (find_photos, "photos_odm_mask", 6),
    (find_photos, "photos_realityscan_mask", 6),
    (find_photos, "photos_masks_folder_same_name", 6),
    (read_model, "ply/inf_opacity.ply", 50),
    (read_model, "ply/neginf_scale.ply", 50),
    (read_model, "ply/nan2.ply", 48),
    (read_model, "sog2_dir.sog", 50),
    (read_model, "sog1.sog", "another version"),
    (read_model, "sog_v2_folder", 50),
    (read_model, "sog_v2_folder/meta.json", 50),
    (read_model, "v4_plain.spz", 50),
    (read_model, "v1_sh0.spz", "not 1"),
    (read_scene, "transforms_frame_angle", 4),
    (read_scene, "tracks_without_observations", 6),
    (read_scene, "transforms_opencv_k4", "coefficient k4"),
    (read_scene, "images_txt_one_line_each", "images.txt: not .*line 2"),
]


@pytest.mark.parametrize("read, name, holds", HOLDS)
def test_case(read, name, holds):
    if isinstance(holds, str):
        with pytest.raises(InputError, match=holds) as refused:
            read(CASES / name)
        assert name in str(refused.value) and "\n" not in str(refused.value)
    elif read is read_model:
        rows = read(CASES / name).rows
        assert all(len(each) == holds and np.isfinite(each).all() for each in rows.values())
    elif read is find_photos:
        photos, refused = find_photos(CASES / name)
        assert not refused and [photo.name for photo in photos] == [f"DJI_000{number}.JPG" for number in range(holds)]
        assert all(photo.mask and photo.name[:8] in photo.mask.name for photo in photos)
    else:
        cameras = [view.camera for view in read(CASES / name).views]
        assert len(cameras) == holds
        assert "angle" not in name or np.allclose([each.focal for each in cameras], 160 / np.tan(np.pi / 6))
