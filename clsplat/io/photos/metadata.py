"""What a photo's file records about where and with which lens it was taken: EXIF and DJI's XMP.

Cameras write these values with errors and leave any of them out. What is not there, is not a
finite number or cannot be true is None.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from clsplat.io.photos.photo import Photo, opened
from clsplat.io.regular import open_regular

MILLIMETRES = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}  # of EXIF's FocalPlaneResolutionUnit
FILM_DIAGONAL = math.hypot(36, 24)  # millimetres
HIGHEST = 100_000.0  # metres; no camera with GPS is farther from sea level
COARSE = 1e-6  # degrees, 0.1 m; EXIF that is rounded to more gives way to XMP
XMP_BYTES = 1 << 18  # from the beginning of a file, among which XMP is
UNIT_DEGREES = (1.0, 1 / 60, 1 / 3600)
DJI, PIX4D = "drone-dji:", "Camera:"
QUARTERS = {3: 2, 6: 1, 8: 3}  # EXIF orientation -> clockwise quarter turns


@dataclass(frozen=True)
class Calibration:
    """The maker's calibration of a camera, in COLMAP's model FULL_OPENCV with k4 = k5 = k6 = 0.

    Attributes
    ----------
    focal, centre : (x, y), pixels of the photo as stored.
    distortion : k1, k2, p1, p2, k3.
    """

    focal: tuple[float, float]
    centre: tuple[float, float]
    distortion: tuple[float, float, float, float, float]


@dataclass(frozen=True)
class PhotoMetadata:
    """What a photo's file records about where and with which lens it was taken.

    Attributes
    ----------
    width, height : pixels as stored.
    orientation : EXIF's number, 1 to 8, of the turn that shows the photo upright; 1 without one.
    camera : make, model and serial number of the body, "" if unknown.
    lens : name and focal length, "" if unknown.
    focal_pixels : focal length in pixels of the photo as stored, an estimate.
    calibration : by the maker, for photos whose distortion is not corrected.
    latitude, longitude : degrees, WGS 84, positive to the north and east; both or neither.
    altitude : metres above sea level; often wrong by tens of metres, or above something else.
    above_ellipsoid : whether the altitude is above the ellipsoid, by the file.
    void : whether the receiver marked the position as void.
    gps_std : standard deviations to the east, to the north and up, metres (RTK of DJI, or Pix4D's
        tags, which other makers use).
    gimbal_pitch, gimbal_roll : degrees (DJI); the pitch of a camera that looks straight down is
        -90.
    """

    width: int
    height: int
    orientation: int = 1
    camera: str = ""
    lens: str = ""
    focal_pixels: float | None = None
    calibration: Calibration | None = None
    latitude: float | None = None
    longitude: float | None = None
    altitude: float | None = None
    above_ellipsoid: bool = False
    void: bool = False
    gps_std: tuple[float, float, float] | None = None
    gimbal_pitch: float | None = None
    gimbal_roll: float | None = None

    @property
    def quarter_turns(self) -> int:
        """How many clockwise quarter turns show the photo upright; mirrored photos are not turned.
        """
        return QUARTERS.get(self.orientation, 0)


def read_metadata(path: str | Path) -> PhotoMetadata:
    """Read the metadata of a photo from its header.

    Parameters
    ----------
    path : of the photo.

    Raises
    ------
    InputError : the file is not a photo that can be read.
    """
    with opened(path) as photo:
        latitude, longitude = _position(photo, path)
        return PhotoMetadata(
            photo.width, photo.height,
            photo.orientation if photo.orientation in range(1, 9) else 1,
            _words(photo, "Make", "Model", "Exif:BodySerialNumber"),
            _words(photo, "Exif:LensModel", "Exif:FocalLength"),
            _focal_pixels(photo), _calibration(photo), latitude, longitude, _altitude(photo),
            _number(photo, "GPS:AltitudeRef", 3) in (2, 3), _text(photo, "GPS:Status") == "V",
            _gps_std(photo), *(_number(photo, f"{DJI}Gimbal{axis}Degree", 360)
                               for axis in ("Pitch", "Roll")))


def _numbers(photo: Photo, name: str) -> list[float]:
    """The finite numbers of an attribute, of which a text may be one; [] if any is not."""
    value = photo.attribute(name)
    try:
        parts = value if isinstance(value, (tuple, list)) else [value]
        values = [float(part) for part in parts]  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return []
    return values if all(map(math.isfinite, values)) else []


def _number(photo: Photo, name: str, limit: float) -> float | None:
    values = _numbers(photo, name)
    return values[0] if len(values) == 1 and abs(values[0]) <= limit else None


def _text(photo: Photo, name: str) -> str:
    value = photo.attribute(name)
    if isinstance(value, float):  # of 32 bits in the file
        value = f"{value:.6g}"
    return "" if value is None else " ".join(str(value).split())


def _words(photo: Photo, *names: str) -> str:
    return " ".join(filter(None, (_text(photo, name) for name in names)))


def _position(photo: Photo, path: str | Path) -> tuple[float, float] | tuple[None, None]:
    """Latitude and longitude, or twice None. Of EXIF and XMP the finer one is taken, if both agree
    within the rounding of EXIF."""
    exif = _degrees(photo, "Latitude", "S", 90), _degrees(photo, "Longitude", "W", 180)
    (latitude, fine), (longitude, fine_too) = exif
    if latitude is None or longitude is None or max(fine, fine_too) > COARSE:
        xmp = (_exact(photo, path, 90, "GpsLatitude"),  # DJI's older programs misspell the other
               _exact(photo, path, 180, "GpsLongitude", "GpsLongtitude"))
        if None not in xmp and xmp != (0, 0) and (latitude is None or longitude is None or all(
                abs(rough - exact) <= rounding  # type: ignore[operator]
                for (rough, rounding), exact in zip(exif, xmp))):
            latitude, longitude = xmp
    # a receiver without satellites writes zeros
    if latitude is None or longitude is None or latitude == longitude == 0:
        return None, None
    return latitude, longitude


def _exact(photo: Photo, path: str | Path, limit: float, *names: str) -> float | None:
    """A number of DJI's XMP, of which OpenImageIO keeps seven digits."""
    for name in names:
        value = _number(photo, DJI + name, limit)
        if value is not None:
            with open_regular(path) as file:
                content = file.read(XMP_BYTES)
            found = re.search(rf"{DJI}{name}\s*(?:=\s*[\"']|>)\s*([-+.\d]+)".encode(), content)
            digits = _finite([found[1].decode()]) if found else []
            return digits[0] if digits and abs(digits[0] - value) < 1e-4 else value
    return None


def _degrees(photo: Photo, name: str, negative: str, limit: float) -> tuple[float | None, float]:
    """An angle of EXIF, which has one to three parts, and by how much it is rounded, degrees."""
    parts = _numbers(photo, "GPS:" + name)
    if not 1 <= len(parts) <= 3 or min(parts) < 0:
        return None, 0.0
    value = sum(part * unit for part, unit in zip(parts, UNIT_DEGREES))
    last = max((row for row, part in enumerate(parts) if part), default=0)
    rounding = _rounding(parts[last]) * UNIT_DEGREES[last]
    sign = -1 if _text(photo, f"GPS:{name}Ref")[:1].upper() == negative else 1
    return (sign * value if value <= limit else None), rounding


def _rounding(value: float) -> float:
    """By how much a number is rounded that is written with few digits, or in 32 bits."""
    noise = value * 2.0**-22
    return next((10.0**-digits for digits in range(7)
                 if abs(value - round(value, digits)) <= noise), noise)


def _altitude(photo: Photo) -> float | None:
    value = _number(photo, "GPS:Altitude", HIGHEST)
    if not value:  # what firmware writes that fills in XMP alone
        absolute = _number(photo, DJI + "AbsoluteAltitude", HIGHEST)
        return value if absolute is None else absolute
    return -value if _number(photo, "GPS:AltitudeRef", 3) in (1, 3) else value


def _gps_std(photo: Photo) -> tuple[float, float, float] | None:
    values = [_number(photo, f"{DJI}RtkStd{axis}", HIGHEST) for axis in ("Lon", "Lat", "Hgt")]
    if None in values:
        ground, height = (_number(photo, f"{PIX4D}GPS{axis}Accuracy", HIGHEST)
                          for axis in ("XY", "Z"))
        values = [ground, ground, height]
    east, north, up = values
    if east is None or north is None or up is None or min(east, north, up) <= 0:
        return None
    return east, north, up


def _reduction(photo: Photo) -> float:
    """How many times the photo is larger than when the camera wrote its header."""
    taken = _number(photo, "Exif:PixelXDimension", 1e9), _number(photo, "Exif:PixelYDimension", 1e9)
    width, height = taken
    if width is None or height is None or min(width, height) < 1:
        return 1.0
    return max(photo.width, photo.height) / max(width, height)


def _focal_pixels(photo: Photo) -> float | None:
    """The focal length by the resolution of the sensor, or else by the equivalent of 35 mm film,
    which makers take by the diagonal."""
    size = math.hypot(photo.width, photo.height)
    millimetres = _number(photo, "Exif:FocalLength", 1e5)
    per_unit = _number(photo, "Exif:FocalPlaneXResolution", 1e9)
    unit = MILLIMETRES.get(int(_number(photo, "Exif:FocalPlaneResolutionUnit", 5) or 2))
    film = _number(photo, "Exif:FocalLengthIn35mmFilm", 1e5)
    estimates = []
    if millimetres and per_unit and unit:
        estimates.append(millimetres / unit * per_unit * _reduction(photo))
    if film:
        estimates.append(film / FILM_DIAGONAL * size)
    # a sensor resolution in wrong units gives angles of view that no lens has
    return next((value for value in estimates if 0.1 * size < value < 100 * size), None)


def _calibration(photo: Photo) -> Calibration | None:
    """DJI's DewarpData: "date;fx,fy,cx,cy,k1,k2,p1,p2,k3", the centre from the photo's middle."""
    text = _text(photo, DJI + "DewarpData").rpartition(";")[2].split(",")
    values = _finite(text)
    if len(values) != 9 or _number(photo, DJI + "DewarpFlag", 1) == 1:  # 1: it is corrected
        return None
    scale = _reduction(photo)
    focal_x, focal_y, x, y = (scale * value for value in values[:4])
    size = max(photo.width, photo.height)
    if not (0.1 * size < min(focal_x, focal_y) and max(focal_x, focal_y) < 100 * size
            and max(abs(x), abs(y)) < 0.2 * size and max(map(abs, values[4:])) < 10):
        return None
    k1, k2, p1, p2, k3 = values[4:]
    return Calibration((focal_x, focal_y), (photo.width / 2 + x, photo.height / 2 + y),
                       (k1, k2, p1, p2, k3))


def _finite(texts: Sequence[str]) -> list[float]:
    try:
        values = [float(text) for text in texts]
    except ValueError:
        return []
    return values if all(map(math.isfinite, values)) else []
