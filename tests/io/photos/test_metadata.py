"""Metadata of photos: EXIF and DJI's XMP, whole, missing, and wrong."""

from datetime import datetime, timedelta, timezone

import numpy as np
import OpenImageIO as oiio
import pytest

from clsplat.io.photos.metadata import read_metadata

GPS = {
    "GPS:LatitudeRef": "S",
    "GPS:Latitude": (30.0, 10.0, 16.14),
    "GPS:LongitudeRef": "W",
    "GPS:Longitude": (98.0, 5.0, 23.526),
    "GPS:AltitudeRef": 0,
    "GPS:Altitude": 318.9,
}


def photo(path, exif=None, xmp=None, size=(64, 48)):
    """Write a JPEG with these EXIF attributes and these values of DJI's XMP."""
    spec = oiio.ImageSpec(*size, 3, oiio.UINT8)
    for name, value in (exif or {}).items():
        if isinstance(value, tuple):
            spec.attribute(name, oiio.TypeDesc(f"float[{len(value)}]"), value)
        else:
            spec.attribute(name, value)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec)
    assert output.write_image(np.zeros((size[1], size[0], 3), np.uint8)) and output.close()
    if xmp is not None:
        values = " ".join(f'{name if ":" in name else "drone-dji:" + name}="{value}"' for name, value in xmp.items())
        text = (
            'http://ns.adobe.com/xap/1.0/\0<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF '
            'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description '
            f'xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" '
            f'xmlns:Camera="http://pix4d.com/camera/1.0" {values}/></rdf:RDF>'
            "</x:xmpmeta>"
        ).encode()
        data = path.read_bytes()
        path.write_bytes(data[:2] + b"\xff\xe1" + (len(text) + 2).to_bytes(2, "big") + text + data[2:])
    return path


def test_a_photo_without_metadata_has_its_size_only(tmp_path):
    data = read_metadata(photo(tmp_path / "a.jpg"))
    assert (data.width, data.height, data.orientation) == (64, 48, 1)
    assert data.camera == data.lens == ""
    assert {
        data.focal_pixels,
        data.calibration,
        data.latitude,
        data.longitude,
        data.altitude,
        data.gps_std,
        data.gimbal_pitch,
    } == {None}


def test_position_has_signs(tmp_path):
    data = read_metadata(photo(tmp_path / "a.jpg", GPS))
    assert data.latitude == pytest.approx(-(30 + 10 / 60 + 16.14 / 3600), abs=1e-8)
    assert data.longitude == pytest.approx(-(98 + 5 / 60 + 23.526 / 3600), abs=1e-8)
    assert data.altitude == pytest.approx(318.9, abs=1e-3)
    below = {**GPS, "GPS:AltitudeRef": 1, "GPS:LatitudeRef": "N", "GPS:LongitudeRef": "E"}
    data = read_metadata(photo(tmp_path / "b.jpg", below))
    assert data.altitude < 0 < min(data.latitude, data.longitude)


CLOCK = {"Exif:DateTimeOriginal": "2024:06:01 23:59:58"}
UTC = {"GPS:DateStamp": "2024:06:02", "GPS:TimeStamp": (3.0, 59.0, 58.7)}
ZONE = timezone(timedelta(hours=-4))


@pytest.mark.parametrize(
    "exif, expected",
    [
        ({}, None),
        (CLOCK, datetime(2024, 6, 1, 23, 59, 58)),
        ({**CLOCK, "Exif:OffsetTimeOriginal": "-04:00"}, datetime(2024, 6, 1, 23, 59, 58, tzinfo=ZONE)),
        ({**CLOCK, "Exif:OffsetTimeOriginal": "soon"}, datetime(2024, 6, 1, 23, 59, 58)),
        ({**CLOCK, **UTC}, datetime(2024, 6, 2, 3, 59, 58, tzinfo=timezone.utc)),
        ({**CLOCK, "GPS:DateStamp": "2024:06:02"}, datetime(2024, 6, 1, 23, 59, 58)),
        ({"Exif:DateTimeOriginal": "0000:00:00 00:00:00"}, None),
        ({"Exif:DateTimeOriginal": "0001:01:01 00:00:00"}, None),
        ({**UTC, "GPS:TimeStamp": (1e30, 0.0, 0.0)}, None),
    ],
)
def test_when_it_was_taken(tmp_path, exif, expected):
    found = read_metadata(photo(tmp_path / "a.jpg", exif)).taken
    assert found == expected and (found is None or found.tzinfo == expected.tzinfo)


@pytest.mark.parametrize(
    "wrong",
    [
        {"GPS:Latitude": (0.0, 0.0, 0.0), "GPS:Longitude": (0.0, 0.0, 0.0)},
        {"GPS:Latitude": (91.0, 0.0, 0.0)},
        {"GPS:Longitude": (181.0, 0.0, 0.0)},
    ],
)
def test_positions_that_cannot_be_true_are_left_out(tmp_path, wrong):
    data = read_metadata(photo(tmp_path / "a.jpg", {**GPS, **wrong}))
    assert data.latitude is None and data.longitude is None


COARSE = {
    "GPS:LatitudeRef": "N",
    "GPS:Latitude": (42.0, 17.0, 56.0),
    "GPS:LongitudeRef": "W",
    "GPS:Longitude": (71.0, 6.0, 6.0),
    "GPS:AltitudeRef": 0,
    "GPS:Altitude": 0.0,
}
FINE = {"GpsLatitude": "+42.298913477", "GpsLongitude": "-71.101793218", "AbsoluteAltitude": "+433.86"}
OF_XMP, OF_EXIF = (42.298913477, -71.101793218), (42 + 17 / 60 + 56 / 3600, -71.1 - 6 / 3600)


@pytest.mark.parametrize(
    "exif, xmp, place, altitude",
    [
        ({}, {}, OF_XMP, 433.86),  # whole seconds and no altitude give way to XMP that agrees
        ({"GPS:Altitude": 12.5}, {}, OF_XMP, 12.5),
        ({}, {"AbsoluteAltitude": "nan"}, OF_XMP, 0),
        ({}, {"GpsLatitude": "+42.31"}, OF_EXIF, 433.86),  # it does not agree
        ({}, {"GpsLatitude": "a"}, OF_EXIF, 433.86),  # XMP has a longitude alone
        (
            {"GPS:Latitude": (42.0, 17.0, 56.0885), "GPS:Longitude": (71.0, 6.0, 6.4556)},
            {},
            (42.29891347, -71.10179322),
            433.86,
        ),
        ({"GPS:Status": "V", "GPS:LatitudeRef": "North", "GPS:LongitudeRef": "w"}, {}, OF_XMP, 433.86),
        ({"GPS:Altitude": 5.0, "GPS:AltitudeRef": 3}, {}, OF_XMP, -5),
    ],
)
def test_the_finer_of_two_sources_that_agree(tmp_path, exif, xmp, place, altitude):
    data = read_metadata(photo(tmp_path / "a.jpg", {**COARSE, **exif}, {**FINE, **xmp}))
    assert (data.latitude, data.longitude) == pytest.approx(place, abs=5e-6)  # of 32 bits
    assert data.altitude == pytest.approx(altitude, abs=1e-4)
    assert data.void == ("GPS:Status" in exif)
    assert data.above_ellipsoid == (exif.get("GPS:AltitudeRef") in (2, 3))


def test_accuracies_of_pix4d(tmp_path):
    data = read_metadata(photo(tmp_path / "a.jpg", GPS, {"Camera:GPSXYAccuracy": 2, "Camera:GPSZAccuracy": 3}))
    assert data.gps_std == (2, 2, 3)


def test_accuracy_of_exif_and_of_rtk_that_did_not_work(tmp_path):
    error = {**GPS, "GPS:HPositioningError": 4.5}
    assert read_metadata(photo(tmp_path / "a.jpg", error)).gps_std == (4.5, 4.5, 9)
    for flag, std in (("16", (4.5, 4.5, 9)), ("50", (0.01, 0.02, 0.03))):
        data = read_metadata(photo(tmp_path / "b.jpg", error, {**DJI, "RtkFlag": flag}))
        assert data.gps_std == pytest.approx(std)


def test_focal_length_follows_the_sensor_or_the_film(tmp_path):
    sensor = {"Exif:FocalLength": 5.0, "Exif:FocalPlaneXResolution": 254.0, "Exif:FocalPlaneResolutionUnit": 2}
    data = read_metadata(photo(tmp_path / "a.jpg", sensor))
    assert data.focal_pixels == pytest.approx(50)
    # made smaller by half after it was taken
    data = read_metadata(photo(tmp_path / "b.jpg", {**sensor, "Exif:PixelXDimension": 128, "Exif:PixelYDimension": 96}))
    assert data.focal_pixels == pytest.approx(25)
    data = read_metadata(photo(tmp_path / "c.jpg", {"Exif:FocalLengthIn35mmFilm": 40}))
    assert data.focal_pixels == pytest.approx(40 / np.hypot(36, 24) * 80, rel=1e-4)
    absurd = {**sensor, "Exif:FocalPlaneXResolution": 2.54}
    assert read_metadata(photo(tmp_path / "d.jpg", absurd)).focal_pixels is None


DJI = {
    "GimbalPitchDegree": "-90.00",
    "GimbalRollDegree": "0.00",
    "AbsoluteAltitude": "+349.58",
    "RtkStdLon": "0.01",
    "RtkStdLat": "0.02",
    "RtkStdHgt": "0.03",
    "GpsLatitude": "45.25",
    "GpsLongtitude": "-7.5",
    "DewarpFlag": "0",
    "DewarpData": "2022-03-02;60,59,-1,2,-0.4,0.3,0.01,0.02,-0.2",
}


def test_dji(tmp_path):
    data = read_metadata(photo(tmp_path / "a.jpg", xmp=DJI))
    assert (data.gimbal_pitch, data.gimbal_roll) == (-90, 0)
    assert (data.latitude, data.longitude) == (45.25, -7.5)
    assert data.altitude == pytest.approx(349.58)
    assert data.gps_std == pytest.approx((0.01, 0.02, 0.03))
    assert data.calibration == (60, 59, 31, 26, -0.4, 0.3, 0.01, 0.02)


@pytest.mark.parametrize(
    "change",
    [
        {"DewarpFlag": "1"},
        {"DewarpData": "2022;60,59,-1,2"},
        {"DewarpData": "2022;a,b"},
        {"DewarpData": "2022;nan,59,-1,2,0,0,0,0,0"},
        {"DewarpData": "2022;0,59,-1,2,0,0,0,0,0"},
    ],
)
def test_a_calibration_that_does_not_hold_is_left_out(tmp_path, change):
    assert read_metadata(photo(tmp_path / "a.jpg", xmp={**DJI, **change})).calibration is None
