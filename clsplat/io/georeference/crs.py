"""Coordinate reference systems (CRS): their names, and the conversion between them.

Only this module uses pyproj, which takes a tenth of a second to import and is seldom needed.
"""

import re
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.errors import InputError, clean, reason

# of WGS 84: latitude and longitude; the same with heights; x, y and z in metres
WGS84, GEODETIC, GEOCENTRIC = "EPSG:4326", "EPSG:4979", "EPSG:4978"
UTM_EPSG = re.compile(r"EPSG:32([67])(0[1-9]|[1-5]\d|60)")
UTM_WORDS = re.compile(
    r"(?:WGS ?84)?[ /]*UTM (?:zone )?(0?[1-9]|[1-5]\d|60) ?([C-HJ-NP-X])", re.IGNORECASE
)  # N and S are hemispheres, all other letters bands
MARGIN = 5.0  # degrees around the area of use of a CRS, in which maps still use it
WEB_MERCATOR = "1024"  # EPSG's code of its projection
SHOWN = 60  # characters of a CRS in a message
LONGEST_DEFINITION = 20_000  # characters of a CRS

Conversion = Callable[[ArrayLike], NDArray[np.float64]]


def normal_crs(text: str, name: str = "--crs") -> str:
    """A CRS as "EPSG:..." or, if it has no code, as one line of WKT2.

    Parameters
    ----------
    text : such as "EPSG:25832", "WGS84 UTM 32N", a PROJ string or WKT.
    name : of the option or file that it comes from, for messages.
    """
    text = " ".join(text.split())
    words = UTM_WORDS.fullmatch(text)
    if words and words[2] not in "nNsS":
        raise InputError(
            f"{name} {_shown(text)}: {words[2]} is a latitude band; write N or S, for "
            f"the northern or the southern hemisphere, such as WGS84 UTM {words[1]}N"
        )
    if words:
        return f"EPSG:32{'6' if words[2] in 'nN' else '7'}{int(words[1]):02d}"
    return _name(pyproj_crs(text, name))


def has_metres(system: Any) -> bool:
    """Whether a pyproj.CRS is projected, with metres of the ground to the east and north, in
    whatever order."""
    axes = {(axis.direction, axis.unit_conversion_factor) for axis in system.axis_info[:2]}
    if not system.is_projected or axes != {("east", 1.0), ("north", 1.0)}:
        return False  # pyproj's `always_xy` brings others to east, north, but not west to east
    operation = _flat(system).coordinate_operation
    return operation is None or operation.method_code != WEB_MERCATOR


def scene_crs(text: str) -> str:
    """`normal_crs` of the option --crs; InputError unless it is projected, with metres of the
    ground to the east and north."""
    crs = normal_crs(text)
    if not has_metres(pyproj_crs(crs, "--crs")):
        raise InputError(
            f"--crs {_shown(text)}: is not a projected coordinate reference system in "
            "metres of the ground (as Web Mercator's are not); give one such as "
            "EPSG:32632, which is UTM zone 32 north"
        )
    return crs


def project_crs(definition: str) -> str:
    """The horizontal CRS of another program's project, as `normal_crs` returns it, if its first two
    coordinates are metres; "" if it is another, or none that pyproj accepts."""
    try:
        system = _flat(pyproj_crs(definition[:LONGEST_DEFINITION], "the project"))
    except InputError:
        return ""
    return _name(system) if has_metres(system) else ""


def _name(system: Any) -> str:
    code = system.to_authority(min_confidence=70)
    return ":".join(code) if code else " ".join(system.to_wkt().split())


def utm_zone(longitude: float, latitude: float) -> str:
    """The EPSG code of the UTM zone (WGS 84) of a place, degrees."""
    zone = int((longitude + 180) // 6) % 60 + 1
    return f"EPSG:{(32600 if latitude >= 0 else 32700) + zone}"


def conversion(source: str, target: str, why: str = "CRS", partial: bool = False) -> Conversion:
    """A function that converts points [N, 2] or [N, 3] of one CRS to another, east or longitude
    first.

    Parameters
    ----------
    source, target : as pyproj accepts them, such as "EPSG:32614". Heights are above the ellipsoid
        where a CRS has none of its own.
    why : what needs it, for messages.
    partial : whether a point without coordinates in the target becomes nan, not an InputError.
    """
    import pyproj

    try:
        first, second = (pyproj.CRS.from_user_input(crs) for crs in (source, target))
        flat = pyproj.Transformer.from_crs(first, second, always_xy=True)
        upright = pyproj.Transformer.from_crs(first.to_3d(), second.to_3d(), always_xy=True)
    except pyproj.exceptions.ProjError as error:
        raise InputError(
            f"{why}: coordinates in {_shown(source)} cannot be converted to "
            f"{_shown(target)} ({reason(error)}); name another CRS"
        ) from None

    def convert(points: ArrayLike) -> NDArray[np.float64]:
        values = np.asarray(points, np.float64)
        used = flat if values.shape[1] == 2 else upright
        result = np.stack(used.transform(*values.T), axis=1)
        lost = ~np.isfinite(result).all(axis=1)
        if lost.any() and not partial:
            raise InputError(
                f"{why}: some places in {_shown(source)} have no coordinates in "
                f"{_shown(target)}; check which CRS they are in"
            )
        result[lost] = np.nan
        return result

    return convert


def on_ground(source: str, target: str, points: ArrayLike) -> NDArray[np.float64]:
    """Points float[N, 3] of one CRS in another one, east or longitude first, whose heights stay as
    they are; nan for what the target cannot represent."""
    result = np.array(points, np.float64).reshape(-1, 3)
    if source != target:
        convert = conversion(source, target, f"CRS {_shown(target)}", partial=True)
        result[:, :2] = convert(result[:, :2])
    return result


def map_positions(degrees: ArrayLike, heights: ArrayLike, crs: str | None = None) -> tuple[NDArray[np.float64], str]:
    """Map coordinates of places, float64[N, 3], nan for those that the CRS cannot represent; and
    that CRS, by default the UTM zone of the places.

    Parameters
    ----------
    degrees : float[N, 2], latitudes and longitudes, WGS 84; at least one place.
    heights : float[N], metres, which are not changed.
    """
    places = np.column_stack([np.asarray(degrees)[:, ::-1], heights]).astype(np.float64)
    valid = (np.abs(places[:, :2]) <= (180, 90)).all(axis=1)
    result = np.full_like(places, np.nan)
    if not valid.any():
        return result, crs or WGS84
    target = crs or utm_zone(*np.median(places[valid, :2], axis=0))
    result[valid] = on_ground(WGS84, target, places[valid])
    return result, target


def is_on_map(system: Any, crs: str) -> bool:
    """Whether coordinates in a pyproj.CRS are in the CRS of a scene, with heights in metres above
    whatever they were measured from."""
    flat, own = _flat(system), _flat(pyproj_crs(crs, "the scene"))
    return heights_of(system).metres == 1 and (flat.equals(own, ignore_axis_order=True) or _name(flat) == _name(own))


def outside(crs: str, points: ArrayLike) -> str:
    """Where the middle of map coordinates [N, 2 or 3] lies, if it is outside the area in which a
    projected CRS is used; "" if it is inside, or if the CRS has no such area."""
    east, north = np.median(np.asarray(points, np.float64)[:, :2], axis=0)
    where = f"at east {east:.0f}, north {north:.0f}"
    ((longitude, latitude, _),) = on_ground(horizontal(crs), WGS84, (east, north, 0.0))
    area = pyproj_crs(crs, "CRS").area_of_use
    if not np.isfinite(latitude):
        return where
    if area is None:
        return ""
    width = min((area.east - area.west) % 360 or 360, 360 - 2 * MARGIN)
    if area.south - MARGIN <= latitude <= area.north + MARGIN and (
        (longitude - area.west + MARGIN) % 360 <= width + 2 * MARGIN
    ):
        return ""
    return f"{where}, which is latitude {latitude:.1f}, longitude {longitude:.1f}"


def horizontal(crs: str) -> str:
    """The horizontal part of a compound CRS, as `normal_crs` returns it; others as they are."""
    system = pyproj_crs(crs, "CRS")
    flat = _flat(system)
    return _name(flat) if flat != system else crs


def _flat(system: Any) -> Any:
    return system.sub_crs_list[0] if system.is_compound else system.to_2d()


class Heights(NamedTuple):
    """The name of the vertical part, "" without one; metres of the unit, and its name. Without a
    vertical part the unit is that of x and y, and the metre with degrees."""

    name: str
    metres: float
    unit: str


def heights_of(crs: Any) -> Heights:
    """What the third coordinates of a CRS are, of a pyproj.CRS or as `normal_crs` returns it."""
    system = pyproj_crs(crs, "CRS")
    axes = system.axis_info
    if len(axes) > 2:
        name = system.sub_crs_list[1].name if system.is_compound else f"height above the ellipsoid of {system.name}"
        return Heights(name, axes[2].unit_conversion_factor, axes[2].unit_name)
    if not system.is_projected:
        return Heights("", 1.0, "metre")
    return Heights("", axes[0].unit_conversion_factor, axes[0].unit_name)


def pyproj_crs(text: Any, name: str) -> Any:
    """The pyproj.CRS of a text; InputError, with this name of the option or file, if there is none."""
    import pyproj

    try:
        return pyproj.CRS.from_user_input(text)
    except (pyproj.exceptions.CRSError, ValueError):  # ValueError: it has a byte 0
        raise InputError(
            f"{name} {_shown(text)}: is not a coordinate reference system; give one such as EPSG:25832"
        ) from None


def _shown(crs: str) -> str:
    return clean(crs)[:SHOWN]
