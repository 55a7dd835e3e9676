"""Positions in DJI's MRK files, by the numbers in the names of photos."""

import pytest

from clsplat.io.photos.metadata import PhotoMetadata
from clsplat.io.photos.mrk import with_mrk

LINE = (
    "{}\t505369.17\t[2364]\t  -339,N\t  -361,E\t   348,V\t{:.8f},Lat\t-115.38278248,Lon\t"
    "1368.634,Ellh\t0.012, 0.010, 0.020\t{},Q\n"
)
AT = PhotoMetadata(64, 48, latitude=51.1, longitude=-115.38278, altitude=12.0, camera="DJI")


def positions(folder, names, known=AT):
    return with_mrk((folder / name, known) for name in names)


def test_a_line_replaces_the_position_of_its_photo(tmp_path):
    (tmp_path / "100_0034_Timestamp.MRK").write_text(
        LINE.format(3, 51.10001, 50)
        + "damaged, 1,Lat\n"
        + LINE.format(4, 51.10002, 16)
        + LINE.format(5, 51.1, 0)
        + LINE.format(6, 51.2, 50)
    )
    names = ["100_0034_0003.JPG", "DJI_20250502142325_0004_V.JPG", "DJI_0005.JPG", "DJI_0006.JPG", "IMG_3.jpg"]
    (fixed, single, *others), notes = positions(tmp_path, names)
    assert (fixed.latitude, fixed.longitude, fixed.altitude) == (51.10001, -115.38278248, 1368.634)
    assert fixed.gps_std == (0.010, 0.012, 0.020) and fixed.above_ellipsoid
    assert (fixed.camera, fixed.width) == ("DJI", 64)
    # one receiver alone does not have the accuracy that it states
    assert single.latitude == 51.10002 and single.gps_std is None
    assert others == 3 * [AT]  # no position, that of another place, and a number that is none
    assert notes == ["2 of 5 photos have a position of an MRK file"]


@pytest.mark.parametrize("latitude, expected", [(51.1, 51.10001), (None, None)])
def test_of_several_flights_the_nearest_counts(tmp_path, latitude, expected):
    for flight, value in (("a", 51.1002), ("b", 51.10001)):
        (tmp_path / f"{flight}_Timestamp.MRK").write_text(LINE.format(1, value, 50))
    known = PhotoMetadata(64, 48, latitude=latitude, longitude=latitude and AT.longitude)
    assert positions(tmp_path, ["DJI_0001.JPG"], known)[0][0].latitude == expected


@pytest.mark.parametrize("content", [b"", b"\xff\x00\xfe" * 99, b"1,Lat 2,Lon\n"])
def test_a_file_without_positions_is_noted_and_not_used(tmp_path, content):
    (tmp_path / "x_Timestamp.MRK").write_bytes(content)
    found, (note,) = positions(tmp_path, ["DJI_0001.JPG"])
    assert found == [AT] and note.endswith("has no position that can be read, and is not used")
