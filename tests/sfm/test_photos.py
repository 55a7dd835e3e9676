"""Which files are photos, which share a camera, and which mask belongs to which."""

import pytest

from clsplat.errors import InputError
from clsplat.sfm.photos import cameras_of, find_photos
from tests.sfm.cases import folder_of, source

EXIF = {
    "Make": "A",
    "Model": "B",
    "Exif:FocalLength": 5.0,
    "Exif:FocalPlaneXResolution": 254.0,
    "Exif:FocalPlaneResolutionUnit": 2,
}


def test_subfolders_are_searched_and_other_files_left_out(tmp_path):
    folder_of(tmp_path, ["b/2.jpg", "a.png", "b/1.JPG", ".hidden/x.jpg", "._a.jpg"])
    (tmp_path / "flight.txt").write_text("text")
    (tmp_path / "broken.jpg").write_bytes(b"no photo")
    photos, refused = find_photos(tmp_path)
    assert [photo.name for photo in photos] == ["a.png", "b/1.JPG", "b/2.jpg"]
    assert list(refused) == ["broken.jpg"] and "not an image" in refused["broken.jpg"]


def test_raw_photos_are_named_unless_a_camera_wrote_both(tmp_path):
    folder_of(tmp_path, ["1.JPG", "2.JPG", "3.JPG"])
    for name in ("1.DNG", "2.avif", "4.heic", "5.avif", "6.dng"):
        (tmp_path / name).write_bytes(b"raw")
    photos, refused = find_photos(tmp_path)
    assert len(photos) == 3 and set(refused) == {"4.heic", "5.avif", "6.dng"}
    assert refused["5.avif"] == "its format is not read: convert it to JPEG"


def test_masks_of_another_shape_are_refused(tmp_path):
    """Of portraits as they are shown, for example, and not as they are stored."""
    folder_of(tmp_path / "images", ["a.jpg", "b.jpg", "c.jpg"])
    folder_of(tmp_path / "masks", ["b.png"], size=(48, 64))
    with pytest.raises(InputError, match="b.png: the mask has 48x64 pixels and its photo 64x48; m"):
        find_photos(tmp_path)


@pytest.mark.parametrize(
    "names, masks, words",
    [
        (["a.jpg", "b.jpg"], None, "2 photos that can be read"),
        (["a.heic", "b.dng"], None, "a.heic: not an image that can be read"),
        (["a.jpg", "b.jpg", "c.jpg"], "elsewhere", "no such folder"),
        (["a.jpg", "b.jpg", "c.jpg"], ".", "has a mask for none of the photos"),
    ],
)
def test_what_cannot_be_reconstructed_is_refused(tmp_path, names, masks, words):
    readable = [name for name in names if name.endswith("jpg")]
    folder_of(tmp_path / "in", readable or ["a/one.jpg"])
    for name in names:
        if not name.endswith("jpg"):
            (tmp_path / "in" / name).write_bytes(b"raw")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=words):
        find_photos(tmp_path / "in", masks and (tmp_path / "empty" if masks == "." else tmp_path / masks))


def test_photos_of_a_body_and_a_lens_share_a_camera(tmp_path):
    folder_of(tmp_path, ["a/1.jpg", "b/2.jpg"], exif=EXIF)
    folder_of(tmp_path, ["a/3.jpg"], exif={**EXIF, "Exif:FocalLength": 10.0})
    folder_of(tmp_path, ["a/4.jpg"], size=(32, 24), exif=EXIF)
    photos, _ = find_photos(tmp_path)
    cameras = cameras_of(photos)
    names = [[photos[row].name for row in camera.photos] for camera in cameras]
    assert names == [["a/1.jpg", "b/2.jpg"], ["a/3.jpg"], ["a/4.jpg"]]
    assert [camera.focal for camera in cameras] == pytest.approx([50, 100, 50])
    assert {camera.focal_known for camera in cameras} == {True}


def test_photos_without_metadata_share_the_camera_of_their_folder():
    photos = [source("a/1.jpg"), source("a/2.jpg"), source("b/3.jpg"), source("a/4.jpg", 48, 64)]
    cameras = cameras_of(photos)
    assert [camera.photos for camera in cameras] == [(0, 1), (2,), (3,)]
    assert cameras[0].focal == 1.2 * 64 and not cameras[0].focal_known
    assert cameras[0].model == "SIMPLE_RADIAL"
    assert cameras_of([source(f"{index}.jpg") for index in range(8)])[0].model == "OPENCV"
    assert cameras_of(photos, "OPENCV_FISHEYE")[0].model == "OPENCV_FISHEYE"


def test_the_makers_calibration_counts_first():
    known = (60.0, 58.0, 31.0, 26.0, -0.4, 0.3, 0.01, 0.02)
    (camera,) = cameras_of([source(camera="DJI", calibration=known, focal_pixels=70.0)])
    assert (camera.model, camera.focal, camera.calibration) == ("OPENCV", 59, known)
