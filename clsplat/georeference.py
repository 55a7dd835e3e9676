"""The place of a scene on the earth, and how well it is known."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

AXES = ("east", "north", "up")
CONTROL, CHECK, LEFT_OUT = "control", "check", "left out"  # roles of measured places
METRES_PER_DEGREE = 111_320.0  # of latitude, near enough to tell neighbours
MOST_RESIDUAL = 0.03  # of the size of a survey; beyond it the residual is a warning


@dataclass(frozen=True)
class Residual:
    """How a georeferenced scene shows one place whose map coordinates were measured."""

    name: str  # of the photo or of the ground control point
    # "control" if it decided where the scene lies, "check" if it took no part, and "left out" if it
    # contradicts the others
    role: str
    # east, north, up: metres, from the measured place to the one in the scene; up is None if no
    # height was measured
    east: float
    north: float
    up: float | None
    # RMS distance of the marks of a ground control point from its known place; None for GPS
    pixels: float | None = None


@dataclass(frozen=True)
class AxisError:
    """Residuals along one direction, metres: their mean, the standard deviation about it, the root
    mean square, and the distance within which 90 % of them are; two are None along the ground."""

    mean: float | None
    sigma: float | None
    rms: float
    within_90: float


@dataclass(frozen=True)
class Georeference:
    """The coordinate reference system (CRS) of a scene.

    A georeferenced scene has axes east, north and up in metres. Its files, and those of models
    trained on it, hold small numbers: map coordinates are `offset` + original coordinates. Only
    formats with room for large numbers (GeoTIFF, LAS) contain the offset.

    Attributes
    ----------
    crs : a projected CRS in metres, as "EPSG:32614" or WKT2.
    offset : (east, north, height), metres: map coordinates of the original origin.
    source : what it was computed from, such as "GPS of 40 photos".
    residual : metres, the root mean square (RMS) distance along the ground between what was
        computed and the source.
    kind : "gps", "gcp" (ground control points), or "" if another program computed it.
    size : metres, the diagonal along the ground of the places that were used; 0 if unknown.
    vertical : what heights count from, a phrase; "" if unknown.
    residuals : of each measured place.
    warnings : sentences that a user must see before the place is relied on.
    """

    crs: str
    offset: tuple[float, float, float]
    source: str
    residual: float
    kind: str = ""
    size: float = 0.0
    vertical: str = ""
    residuals: tuple[Residual, ...] = ()
    warnings: tuple[str, ...] = ()

    def to_map(self, points: ArrayLike) -> NDArray[np.float64]:
        """Map coordinates float64[N, 3] of points float[N, 3] in original coordinates."""
        return np.asarray(points, np.float64) + self.offset

    def from_map(self, points: ArrayLike) -> NDArray[np.float64]:
        """Original coordinates float64[N, 3] of points float[N, 3] in map coordinates."""
        return np.asarray(points, np.float64) - self.offset

    def names(self, role: str) -> tuple[str, ...]:
        """Names of the measured places in a role: "control", "check" or "left out"."""
        return tuple(each.name for each in self.residuals if each.role == role)

    def errors(self, role: str = CONTROL) -> dict[str, AxisError]:
        """The residuals of the places in a role by axis: "east", "north", "up". Axes without any
        are missing."""
        return axis_errors(each for each in self.residuals if each.role == role)


def axis_errors(residuals: Iterable[Residual]) -> dict[str, AxisError]:
    """Mean, standard deviation and RMS of residuals by axis; axes without any are missing."""
    rows = np.array([(each.east, each.north, each.up) for each in residuals], np.float64)
    result = {}
    for axis, column in zip(AXES, rows.reshape(-1, 3).T):
        values = column[np.isfinite(column)]  # of a height that is not known: nan
        if len(values):
            result[axis] = AxisError(
                *(
                    round(float(number), 4)
                    for number in (
                        values.mean(),
                        values.std(),
                        np.sqrt(np.mean(values**2)),
                        np.quantile(np.abs(values), 0.9),
                    )
                )
            )
    return result
