"""Features lie where a photo shows them, whatever its size, and not below masks."""

import numpy as np
import pycolmap
import pytest

from clsplat.io.photos.images import write_image
from clsplat.sfm import features
from clsplat.sfm.features import create_database, extract_features, image_id
from clsplat.sfm.photos import cameras_of, find_photos
from tests.sfm.cases import Lines, picture


def extracted(folder, device):
    photos, _ = find_photos(folder)
    database = folder / "d.db"
    if not database.exists():
        create_database(database, cameras_of(photos))
    progress = Lines()
    failures = extract_features(database, photos, device, 6144, progress)
    with pycolmap.Database.open(database) as opened:
        return (
            [
                opened.read_keypoints(image_id(index)) if opened.exists_keypoints(image_id(index)) else None
                for index in range(len(photos))
            ],
            failures,
            progress,
        )


@pytest.mark.parametrize("working", [120, 480])
def test_features_are_in_pixels_of_the_photo(tmp_path, item_device, monkeypatch, working):
    """A blob is found at its centre though features are searched at another size."""
    monkeypatch.setattr(features, "WORKING_SIZE", working)
    y, x = np.mgrid[:180, :240] + 0.5
    pixels = np.full((180, 240, 3), 40.0)
    for at, size in (((70.0, 60.0), 10.0), ((180.0, 120.0), 9.0)):
        pixels += 180 * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2 * size**2))[..., None]
    for name in ("a.png", "b.png", "c.png"):
        write_image(tmp_path / name, pixels.astype(np.uint8))
    keypoints, failures, _ = extracted(tmp_path, item_device)
    assert not failures
    for at in ((70.0, 60.0), (180.0, 120.0)):
        assert np.linalg.norm(keypoints[0][:, :2] - at, axis=1).min() < 0.75


def test_masked_parts_have_no_features(tmp_path, item_device):
    (tmp_path / "images").mkdir()
    (tmp_path / "masks").mkdir()
    for name in ("a.png", "b.png", "c.png"):
        write_image(tmp_path / "images" / name, picture(60, 80))
    mask = np.full((30, 40, 3), 5, np.uint8)  # nearly black, half the size of the photo
    mask[:, 20:] = 255
    write_image(tmp_path / "masks/a.png", mask)
    keypoints, _, _ = extracted(tmp_path, item_device)
    assert len(keypoints[0]) and keypoints[0][:, 0].min() >= 40
    assert keypoints[1][:, 0].min() < 40


def test_a_second_call_extracts_only_what_is_missing(tmp_path, item_device, monkeypatch):
    for index in range(3):
        write_image(tmp_path / f"{index}.png", picture(60, 80, index))
    damaged = tmp_path / "1.png"
    whole = damaged.read_bytes()
    damaged.write_bytes(whole[: len(whole) // 2])
    keypoints, failures, _ = extracted(tmp_path, item_device)
    assert list(failures) == ["1.png"] and keypoints[1] is None
    damaged.write_bytes(whole)
    seen = []
    own = features._decoded
    monkeypatch.setattr(features, "_decoded", lambda photo: (seen.append(photo.name), own(photo))[1])
    again, failures, progress = extracted(tmp_path, item_device)
    assert seen == ["1.png"] and not failures and len(again[1])
    assert np.array_equal(again[0], keypoints[0])
    assert progress.counts == [("features of photo", 3, 3)]
