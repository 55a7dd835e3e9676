"""HEIC and camera RAW are read as JPEG is: colours, metadata, nothing upside down."""

import sys
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from clsplat.io.photos import decoded, photo
from clsplat.io.photos.images import image_size, read_alpha, read_image, write_image
from clsplat.io.photos.metadata import read_metadata
from clsplat.sfm.photos import find_photos
from tests.data.decoded_photos import exif_of, write_dng, write_heic
from tests.io.photos.test_profiles import COLOURS, SPACES, expected
from tests.refusals import refused

y, x = np.mgrid[:48, :64]
SHADES = np.dstack([4 * x, 5 * y, 2 * x + y]).astype(np.uint8)  # turned or mirrored, it is another


@pytest.fixture
def heic(tmp_path):
    pytest.importorskip("pillow_heif", reason="an extra: pip install '.[photos]'")
    return lambda pixels=SHADES, *rest, **options: write_heic(tmp_path / "a.heic", pixels, *rest, **options)


@pytest.fixture
def dng(tmp_path):
    pytest.importorskip("rawpy", reason="an extra: pip install '.[photos]'")
    return lambda *rest, **options: write_dng(tmp_path / "a.dng", *rest, **options)


def check_metadata(data, model):
    assert (data.camera, data.lens) == (f"Made {model}", "wide 8.8")
    assert data.latitude == pytest.approx(-(30 + 10 / 60 + 16.14 / 3600), abs=1e-7)
    assert data.longitude == pytest.approx(98 + 5 / 60 + 23.526 / 3600, abs=1e-7)
    assert data.altitude == pytest.approx(318.9, abs=1e-3)
    assert data.focal_pixels == pytest.approx(24 / 43.2666 * 80, rel=1e-4)
    assert data.gimbal_pitch == -89.5


@pytest.mark.parametrize(
    "orientation, turned",
    [(1, SHADES), (3, np.rot90(SHADES, 2)), (6, np.rot90(SHADES, -1)), (8, np.rot90(SHADES)), (2, SHADES[:, ::-1])],
)
def test_heic_is_upright(heic, orientation, turned):
    """libheif turns it; EXIF, which phones write too, must not turn it again."""
    path = heic(SHADES, orientation)
    found = read_image(path)
    assert found.shape == turned.shape and np.abs(found - turned.astype(int)).max() <= 3
    data = read_metadata(path)
    assert (data.width, data.height) == image_size(path) == turned.shape[1::-1]
    assert data.orientation == 1
    check_metadata(data, "Phone")
    assert np.array_equal(read_image(path.read_bytes()), found)
    assert np.array_equal(read_image(path.rename(path.with_suffix(".jpg"))), found)


def test_heic_with_alpha_grey_and_a_profile(heic):
    alpha = np.where(SHADES[..., :1] > 100, 255, 0).astype(np.uint8)
    path = heic(np.dstack([SHADES, alpha]))
    with photo.opened(path) as found:
        assert found.has_alpha and found.extra == 0
    assert np.array_equal(read_alpha(path), alpha[..., 0])
    assert np.abs(read_image(path) - SHADES.astype(int)).max() <= 3
    grey = read_image(heic(SHADES[..., 0]))
    assert np.abs(grey - SHADES[..., :1].astype(int)).max() <= 1
    found = read_image(heic(COLOURS, icc_profile=SPACES["P3"]))
    assert np.abs(found - expected("P3")).mean() < 2
    assert np.abs(found - COLOURS.astype(int)).max() > 10


def test_raw_is_developed_in_its_own_white_balance(dng):
    """To sRGB, without a brightness of its own: a bright photo and a dark one have one scale."""
    for brightest in (0.9, 0.4):
        light = np.full((48, 64, 3), 0.25)
        light[:24] = 0.5, 0.1, 0.1
        light[:, :8] = brightest
        found = read_image(dng(light))
        want = 255 * (1.055 * light ** (1 / 2.4) - 0.055)
        for at in ((12, 40), (36, 40), (24, 3)):
            assert np.abs(found[at] - want[at]).max() <= 2, at


@pytest.mark.parametrize("orientation, magic", [(1, b"*\0"), (6, b"*\0"), (8, b"RO"), (3, b"U\0")])
def test_raw_has_the_metadata_of_its_tiff(dng, orientation, magic):
    """It is read as stored, with the turn to do, as JPEG is. Olympus and Panasonic have magic
    numbers of their own."""
    light = np.full((48, 64, 3), 0.25)
    light[:12, :16] = 0.8  # the corner that is stored first
    path = dng(light, orientation=orientation, magic=magic)
    data = read_metadata(path)
    assert (data.width, data.height, data.orientation) == (64, 48, orientation)
    check_metadata(data, "Drone")
    found = read_image(path)
    assert found.shape == (48, 64, 3) and found[4, 4].min() > 200 and found[-4:].max() < 150


def test_pixels_that_are_no_squares_are_refused(dng):
    path = dng(np.full((48, 64, 3), 0.25), scale=(2, 1))
    refused(lambda: read_image(path), "a.dng: ", "another size than its header says")


def test_raw_of_fuji_begins_with_a_jpeg_that_has_its_metadata(tmp_path):
    jpeg = BytesIO()
    Image.fromarray(SHADES).save(jpeg, "JPEG", exif=exif_of("Fuji"))
    (tmp_path / "a.raf").write_bytes(b"FUJIFILMCCD-RAW 0201" + bytes(64) + jpeg.getvalue())
    header = decoded._raw_header(tmp_path / "a.raf")
    (tmp_path / "header.png").write_bytes(header)
    data = read_metadata(tmp_path / "header.png")
    assert (data.camera, data.lens) == ("Made Fuji", "wide 8.8") and data.latitude < -30


def test_a_photo_under_the_name_of_raw_is_what_its_content_says(tmp_path):
    """Photos of a scene keep their names: those that clsplat writes have these, too."""
    write_image(tmp_path / "a.png", SHADES)
    path = (tmp_path / "a.png").rename(tmp_path / "a.DNG")
    assert np.array_equal(read_image(path), SHADES)


@pytest.mark.parametrize("make, package, what", [("heic", "pillow_heif", "HEIC"), ("dng", "rawpy", "camera RAW")])
def test_the_library_that_is_missing_is_named(request, monkeypatch, make, package, what):
    path = request.getfixturevalue(make)(
        np.full((48, 64, 3), 80, np.uint8) if make == "heic" else np.full((48, 64, 3), 0.3)
    )
    monkeypatch.setitem(sys.modules, package, None)
    assert refused(lambda: read_image(path)) == (
        f"{path}: {what} needs {package.replace('_', '-')}, of the extra photos; `pip install pillow-heif rawpy`"
    )


@pytest.mark.parametrize("make, light", [("heic", SHADES), ("dng", np.full((48, 64, 3), 0.3))])
def test_damage(request, make, light):
    path = request.getfixturevalue(make)(light)
    data = path.read_bytes()
    for share in (0.02, 0.3, 0.7):
        path.write_bytes(data[: int(len(data) * share)])
        line = refused(lambda: read_image(path), path.name)
        assert "b'" not in line


def test_a_claim_of_too_many_pixels_is_refused(heic, monkeypatch):
    path = heic()
    monkeypatch.setattr(photo, "MOST_PIXELS", 64 * 48 - 1)
    refused(lambda: read_image(path), "a.heic: damaged: its header claims 64x48 pixels")


def test_they_are_photos_of_a_folder(heic, dng, tmp_path):
    """With masks by their names; RAW beside another photo of its name is left out."""
    dng(np.full((48, 64, 3), 0.3)).rename(tmp_path / "b.DNG")
    heic().rename(tmp_path / "a.HEIC")
    write_image(tmp_path / "c.jpg", SHADES)
    (tmp_path / "c.dng").write_bytes(b"raw")
    (tmp_path / "masks").mkdir()
    for number, name in enumerate(("a.png", "b.DNG.png")):
        Image.fromarray(SHADES[..., number]).save(tmp_path / "masks" / name)
    photos, refusals = find_photos(tmp_path)
    assert [photo.name for photo in photos] == ["a.HEIC", "b.DNG", "c.jpg"] and not refusals
    assert [bool(photo.mask) for photo in photos] == [True, True, False]
    assert photos[0].metadata.latitude == photos[1].metadata.latitude
