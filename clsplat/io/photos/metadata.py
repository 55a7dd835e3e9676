"""What a photo's file records about where and with which lens it was taken: EXIF and DJI's XMP.

Cameras write these values with errors and leave any of them out. What is not there, is not a
finite number or cannot be true is None.
"""

import math
import re
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from clsplat.io.photos.photo import Photo, opened
from clsplat.io.regular import open_regular

MILLIMETRES = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}  # of EXIF's FocalPlaneResolutionUnit
FILM_DIAGONAL = math.hypot(36, 24)  # millimetres
HIGHEST = 100_000.0  # metres; no camera with GPS is farther from sea level
UNIT_DEGREES = (1.0, 1 / 60, 1 / 3600)
DJI = "drone-dji:"
XMP_BYTES = 1 << 18  # from the beginning of a file, among which XMP is
# standard deviations of a position, east, north and up: of DJI's RTK, and Pix4D's for other makers
GPS_STD = (
    [f"{DJI}RtkStd{axis}" for axis in ("Lon", "Lat", "Hgt")],
    [f"Camera:GPS{axis}Accuracy" for axis in ("XY", "XY", "Z")],
)
RTK_FLOAT = 34  # DJI's code, from which on RTK works
DATE, YEARS = "%Y:%m:%d %H:%M:%S", range(1980, 2100)  # of EXIF
QUARTERS = {3: 2, 6: 1, 8: 3}  # EXIF orientation -> clockwise quarter turns
Calibration = tuple[float, ...]  # fx, fy, cx, cy, pixels, and k1, k2, p1, p2, as COLMAP's OPENCV


@dataclass(frozen=True)
class PhotoMetadata:
    """What a photo's file records about where and with which lens it was taken."""

    # width, height: pixels as stored
    width: int
    height: int
    # EXIF's number, 1 to 8, of the turn that shows the photo upright; 1 without one
    orientation: int = 1
    camera: str = ""  # make, model and serial number of the body, "" if unknown
    lens: str = ""  # name and focal length, "" if unknown
    focal_pixels: float | None = None  # focal length in pixels of the photo as stored, an estimate
    # by the maker, of the photo as stored, if its distortion is not corrected
    calibration: Calibration | None = None
    # latitude, longitude: degrees, WGS 84, positive to the north and east; both or neither
    latitude: float | None = None
    longitude: float | None = None
    # metres above sea level; often wrong by tens of metres, or above something else
    altitude: float | None = None
    above_ellipsoid: bool = False  # whether the altitude is above the ellipsoid, by the file
    void: bool = False  # whether the receiver marked the position as void
    # standard deviations to the east, to the north and up, metres (RTK of DJI, Pix4D's tags, which
    # other makers use, or EXIF's for both axes of the ground, and twice that for height)
    gps_std: tuple[float, float, float] | None = None
    # gimbal_pitch, gimbal_roll: degrees (DJI); the pitch of a camera that looks straight down is
    # -90
    gimbal_pitch: float | None = None
    gimbal_roll: float | None = None
    is_deep: bool = False  # whether it is grey, with samples of 16 bits
    # when it was taken: in UTC by the receiver of GPS, else by the clock of the camera, whose time
    # zone is None unless the file has it
    taken: datetime | None = None

    @property
    def quarter_turns(self) -> int:
        """How many clockwise quarter turns show the photo upright; mirrored photos are not turned."""
        return QUARTERS.get(self.orientation, 0)


def read_metadata(path: str | Path) -> PhotoMetadata:
    """Read the metadata of a photo from its header; InputError if the file is none."""
    with opened(path) as photo:
        latitude, longitude = _position(photo, path)
        return PhotoMetadata(
            photo.width,
            photo.height,
            photo.orientation if photo.orientation in range(1, 9) else 1,
            _text(photo, "Make", "Model", "Exif:BodySerialNumber"),
            _text(photo, "Exif:LensModel", "Exif:FocalLength"),
            _focal_pixels(photo),
            _calibration(photo),
            latitude,
            longitude,
            _altitude(photo),
            _number(photo, "GPS:AltitudeRef", 3) in (2, 3),
            _text(photo, "GPS:Status") == "V",
            _gps_std(photo),
            _number(photo, f"{DJI}GimbalPitchDegree", 360),
            _number(photo, f"{DJI}GimbalRollDegree", 360),
            photo.is_deep,
            _taken(photo),
        )


def _numbers(photo: Photo, name: str) -> list[float]:
    """The finite numbers of an attribute, of which a text may be one; [] if any is not."""
    value = photo.attribute(name)
    return _finite(value if isinstance(value, (tuple, list)) else [value])


def _finite(parts: Iterable[Any]) -> list[float]:
    try:
        values = [float(part) for part in parts]
    except (TypeError, ValueError):
        return []
    return values if all(map(math.isfinite, values)) else []


def _number(photo: Photo, name: str, limit: float) -> float | None:
    values = _numbers(photo, name)
    return values[0] if len(values) == 1 and abs(values[0]) <= limit else None


def _text(photo: Photo, *names: str) -> str:
    values = [photo.attribute(name) for name in names]
    return " ".join(
        " ".join((f"{value:.6g}" if isinstance(value, float) else str(value)).split()) for value in values if value
    )  # floats have 32 bits in the file


def _position(photo: Photo, path: str | Path) -> tuple[float, float] | tuple[None, None]:
    """Latitude and longitude, or twice None: of EXIF or, if that has none or whole seconds with
    which it agrees, of XMP."""
    exif = _degrees(photo, "Latitude", "S", 90), _degrees(photo, "Longitude", "W", 180)
    is_whole = not any(part % 1 for name in ("Latitude", "Longitude") for part in _numbers(photo, "GPS:" + name))
    xmp = _xmp_position(photo, path) if None in exif or is_whole else None
    if xmp and (
        None in exif
        or all(
            abs(rough - fine) <= UNIT_DEGREES[-1]  # type: ignore[operator]
            for rough, fine in zip(exif, xmp)
        )
    ):
        return xmp
    latitude, longitude = exif
    # a receiver without satellites writes zeros
    if latitude is None or longitude is None or latitude == longitude == 0:
        return None, None
    return latitude, longitude


def _xmp_position(photo: Photo, path: str | Path) -> tuple[float, float] | None:
    """DJI's latitude and longitude, of which OpenImageIO keeps seven digits: half a metre."""
    if photo.attribute(DJI + "GpsLatitude") is None:
        return None
    with open_regular(path) as file:
        head = file.read(XMP_BYTES)
    values = [
        _finite(re.findall(DJI.encode() + name + rb"\s*(?:=\s*[\"']|>)\s*([-+.\d]+)", head))
        for name in (b"GpsLatitude", b"GpsLongt?itude")
    ]  # older programs misspell it
    if not all(values):
        return None
    (latitude, *_), (longitude, *_) = values
    is_place = abs(latitude) <= 90 and abs(longitude) <= 180 and (latitude or longitude)
    return (latitude, longitude) if is_place else None


def _degrees(photo: Photo, name: str, negative: str, limit: float) -> float | None:
    """An angle of EXIF, which has one to three parts."""
    parts = _numbers(photo, "GPS:" + name)
    if not 1 <= len(parts) <= 3 or min(parts) < 0:
        return None
    value = sum(part * unit for part, unit in zip(parts, UNIT_DEGREES))
    sign = -1 if _text(photo, f"GPS:{name}Ref")[:1].upper() == negative else 1
    return sign * value if value <= limit else None


def _taken(photo: Photo) -> datetime | None:
    text, zone = _text(photo, "GPS:DateStamp"), "+00:00"
    if text and len(clock := _numbers(photo, "GPS:TimeStamp")) == 3:
        text += " {:02.0f}:{:02.0f}:{:02.0f}".format(*map(math.floor, clock))
    else:
        text, zone = _text(photo, "Exif:DateTimeOriginal"), _text(photo, "Exif:OffsetTimeOriginal")
    for zoned, form in ((text + zone, f"{DATE}%z"), (text, DATE)):
        with suppress(ValueError):
            if (found := datetime.strptime(zoned, form)).year in YEARS:
                return found
    return None


def _altitude(photo: Photo) -> float | None:
    value = _number(photo, "GPS:Altitude", HIGHEST)
    if not value:  # what firmware writes that fills in XMP alone
        absolute = _number(photo, DJI + "AbsoluteAltitude", HIGHEST)
        return value if absolute is None else absolute
    return -value if _number(photo, "GPS:AltitudeRef", 3) in (1, 3) else value


def _gps_std(photo: Photo) -> tuple[float, float, float] | None:
    is_rtk = (_number(photo, f"{DJI}RtkFlag", 100) or RTK_FLOAT) >= RTK_FLOAT
    for names in GPS_STD[not is_rtk :]:
        values = [_number(photo, name, HIGHEST) or 0.0 for name in names]
        if min(values) > 0:
            east, north, up = values
            return east, north, up
    error = _number(photo, "GPS:HPositioningError", HIGHEST) or 0.0
    return (error, error, 2 * error) if error > 0 else None


def _reduction(photo: Photo) -> float:
    """How many times the photo is larger than when the camera wrote its header."""
    taken = [_number(photo, f"Exif:Pixel{axis}Dimension", 1e9) or 0.0 for axis in "XY"]
    return max(photo.width, photo.height) / max(taken) if min(taken) >= 1 else 1.0


def _focal_pixels(photo: Photo) -> float | None:
    """The focal length by the resolution of the sensor, or else by the equivalent of 35 mm film,
    which makers take by the diagonal."""
    size = math.hypot(photo.width, photo.height)
    millimetres = _number(photo, "Exif:FocalLength", 1e5) or 0.0
    per_unit = _number(photo, "Exif:FocalPlaneXResolution", 1e9) or 0.0
    unit = MILLIMETRES.get(int(_number(photo, "Exif:FocalPlaneResolutionUnit", 5) or 2), math.inf)
    film = _number(photo, "Exif:FocalLengthIn35mmFilm", 1e5) or 0.0
    estimates = millimetres / unit * per_unit * _reduction(photo), film / FILM_DIAGONAL * size
    # a sensor resolution in wrong units gives angles of view that no lens has
    return next((value for value in estimates if 0.1 * size < value < 100 * size), None)


def _calibration(photo: Photo) -> Calibration | None:
    """DJI's DewarpData: "date;fx,fy,cx,cy,k1,k2,p1,p2,k3", the centre from the photo's middle."""
    values = _finite(_text(photo, DJI + "DewarpData").rpartition(";")[2].split(","))
    if len(values) != 9 or _number(photo, DJI + "DewarpFlag", 1) == 1:  # 1: it is corrected
        return None
    scale = _reduction(photo)
    focal_x, focal_y, x, y = (scale * value for value in values[:4])
    size = max(photo.width, photo.height)
    if not (
        0.1 * size < min(focal_x, focal_y)
        and max(focal_x, focal_y) < 100 * size
        and max(abs(x), abs(y)) < 0.2 * size
        and max(map(abs, values[4:])) < 10
    ):
        return None
    return focal_x, focal_y, photo.width / 2 + x, photo.height / 2 + y, *values[4:8]
