"""Gives a COLMAP reconstruction its place on the earth: metres, east, north and up."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pycolmap
import scipy
from numpy.typing import ArrayLike, NDArray

from clsplat.georeference import CHECK, CONTROL, LEFT_OUT, Georeference, Residual
from clsplat.io.georeference.adjustment import Located, adjust, locate, residuals
from clsplat.io.georeference.control_points import ControlPoints
from clsplat.io.georeference.crs import UTM_EPSG, heights_of, horizontal, map_positions, outside
from clsplat.io.georeference.priors import PriorEffect, adjust_to_positions, centres_of, rms
from clsplat.io.georeference.vertical import vertical_of
from clsplat.io.photos.metadata import PhotoMetadata
from clsplat.placement import plausible
from clsplat.placement.alignment import LEAST_POSITIONS, Alignment, Similarity
from clsplat.placement.plausible import Guess, NotGeoreferenced, TooFewPositions, believed, doubts
from clsplat.placement.up import UP, Vertical

UNKNOWN_STD = 3.0  # metres, of GPS that does not state it, among photos that do
MOST_RTK = 0.5  # share of the photos with RTK from which on it decides where the scene lies
RTK_STD = 0.1  # metres; positions that state less have errors of their own, others drift together
FOOT = 0.3048
SHOWN = 5  # names in a sentence
FARTHEST = 1000.0  # metres from the photos' GPS to where control points place them
ELLIPSOIDAL = "the photos' GPS altitudes, above the ellipsoid"
SEA_LEVEL = "the photos' GPS altitudes, nominally above sea level"
SIGN = "is the longitude (E, W) or the latitude (N, S) wrong in sign?"
EXCHANGED = "are x and y exchanged, or has one of them the wrong sign?"


@dataclass(frozen=True, eq=False)
class Placed:
    """What became of a reconstruction."""

    georeference: Georeference | None  # of its new coordinates; None if it is not georeferenced
    up: NDArray[np.float64]  # float64[3], the unit vector that points up in them
    notes: tuple[str, ...]  # lines for the user: what was done, with residuals, or why it was not
    warnings: tuple[str, ...] = ()  # sentences that a user must see, even if all else is quiet
    # what the photos' positions changed in an adjustment; None: there was none
    priors: PriorEffect | None = None


def place_reconstruction(
    reconstruction: pycolmap.Reconstruction,
    metadata: Mapping[str, PhotoMetadata],
    control: ControlPoints,
    *,
    up: ArrayLike | None = None,
    adjusts: bool = False,
    keep_focal: bool = False,
) -> Placed:
    """Turn, scale and move a reconstruction in place, so that its axes are east, north and up.

    Ground control points decide if there are any, otherwise GPS.

    Parameters
    ----------
    reconstruction : with the cameras of the photos as they were taken, before undistortion.
    metadata : of the photos, by their names in the reconstruction; some may be missing.
    control : ground control points, and the coordinate reference system; "": the UTM zone.
    up : float[3], in the reconstruction, the direction that points up; None: by gimbals or cameras.
    adjusts : whether cameras and points are then adjusted to the control points, or else to the
        photos' positions; otherwise the reconstruction keeps its shape.
    keep_focal : whether that adjustment keeps focal lengths.

    Raises
    ------
    NotGeoreferenced : nothing determines the place, or the result cannot be right. After
        `adjusts` the reconstruction may have changed, and is of no use.
    """
    images, points = _content(reconstruction)
    known_up = vertical_of(images, points, metadata, up)
    located, lost = locate(reconstruction, control.points)
    used = [item for item in located if not item.point.is_check]
    measured = _by_control(used, lost, control) if control.points else _by_gps(images, metadata, control.crs or None)
    is_control = bool(control.points)
    result = believed(
        measured.places, measured.positions, known_up, measured.guesses, std=measured.std, is_control=is_control
    )
    if is_control:
        require_near_gps(result, images, metadata, measured.crs)
    ground = np.median(result.similarity(points if len(points) else centres_of(images)), axis=0)
    offset = np.round(ground)
    _move(reconstruction, result.similarity, offset)
    effect = None
    if is_control:
        used = (
            adjust(reconstruction, used, offset, keep_focal)
            if adjusts
            else [item for item, right in zip(used, result.used & result.used_heights) if right]
        )
        found = residuals(reconstruction, located, used, offset)
        source, errors, notes = _by_residuals(found, lost, adjusts)
    else:
        effect = (
            _adjusted_to_gps(reconstruction, images, measured, result, known_up, offset, keep_focal)
            if adjusts
            else None
        )
        found, source, errors = _by_positions(images, measured, result, offset)
        height = f", {errors[1]:.2f} m in height" * bool(np.isfinite(errors[1]))
        notes = [
            f"georeferenced by the {source}: residual {errors[0]:.2f} m along the ground{height}",
            *([str(effect)] if effect else []),
        ]
    warnings = doubts(result, measured.positions, known_up, errors, is_control)
    east, north, height_of_origin = offset.tolist()
    return Placed(
        Georeference(
            measured.crs,
            (east, north, height_of_origin),
            source,
            errors[0],
            "gcp" if is_control else "gps",
            round(result.size, 3),
            measured.vertical,
            found,
            tuple(warnings),
        ),
        UP,
        (*control.notes, *notes, *measured.notes),
        tuple(warnings),
        effect,
    )


def turned(
    reconstruction: pycolmap.Reconstruction, metadata: Mapping[str, PhotoMetadata], why: NotGeoreferenced
) -> Placed:
    """Turn a reconstruction that has no place in place, so that the direction (0, -1, 0) points up,
    as most viewers expect.

    Parameters
    ----------
    reconstruction, metadata : as for `place_reconstruction`.
    why : it has no place.
    """
    target = np.array([0.0, -1.0, 0.0])
    up = vertical_of(*_content(reconstruction), metadata, None).up
    rotation = scipy.spatial.transform.Rotation.align_vectors(target, up)[0].as_matrix()
    reconstruction.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(rotation), np.zeros(3)))
    notes = (f"not georeferenced: {why}",)
    return Placed(None, target, notes, () if isinstance(why, TooFewPositions) else notes)


def _rotations(images: Sequence[Any]) -> NDArray[np.float64]:
    return np.array([image.cam_from_world().rotation.matrix() for image in images])


def _move(reconstruction: Any, similarity: Similarity, offset: NDArray[np.float64]) -> None:
    reconstruction.transform(
        pycolmap.Sim3d(similarity.scale, pycolmap.Rotation3d(similarity.rotation), similarity.translation - offset)
    )


def _content(reconstruction: pycolmap.Reconstruction) -> tuple[list[Any], NDArray[np.float64]]:
    """The images with a pose, by name, and the points [N, 3]."""
    images = sorted((image for image in reconstruction.images.values() if image.has_pose), key=lambda image: image.name)
    return images, np.array([point.xyz for point in reconstruction.points3D.values()]).reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class _Measured:
    """Positions of photos or of ground control points: `places` in the reconstruction, and
    `positions` in map coordinates, nan for what is unknown, with what they may be instead."""

    names: list[str]
    places: NDArray[np.float64]
    positions: NDArray[np.float64]
    guesses: list[Guess]
    crs: str
    vertical: str
    std: NDArray[np.float64] | None = None
    notes: tuple[str, ...] = ()


def _by_control(located: Sequence[Located], lost: Sequence[str], control: ControlPoints) -> _Measured:
    """Ground control points; NotGeoreferenced if they are too few, or outside their CRS."""
    if len(located) < LEAST_POSITIONS:
        missing = f" (not located: {_listed(lost)})" if lost else ""
        raise NotGeoreferenced(
            f"--gcp: {len(located)} of {len(located) + len(lost)} ground control points can be "
            f"located in the photos, and {LEAST_POSITIONS} are needed{missing}; mark each in two "
            "photos or more, by the names and in the pixels of the photos that were reconstructed"
        )
    crs, positions = control.crs, np.array([item.point.position for item in located])
    degrees = (np.abs(positions[:, :2]) <= (180, 90)).all()
    where = outside(crs, positions) or ("within 200 m of the origin" if degrees and UTM_EPSG.fullmatch(crs) else "")
    if where:
        question = (
            "are they degrees? Then EPSG:4326 belongs into the first line"
            if degrees
            else "is it the right CRS, and are x and y exchanged?"
        )
        raise NotGeoreferenced(
            f"--gcp: the ground control points lie {where}, outside the area of {crs[:60]}: {question}"
        )
    guesses = [
        Guess(EXCHANGED, positions[:, [1, 0, 2]]),
        Guess("are heights positive downwards?", positions * (1, 1, -1)),
        Guess("are heights in feet?", positions * (1, 1, FOOT)),
    ]
    return _Measured(
        [item.point.name for item in located],
        np.array([item.place for item in located]),
        positions,
        guesses,
        crs,
        control.vertical,
    )


def _by_gps(images: Sequence[Any], metadata: Mapping[str, PhotoMetadata], crs: str | None) -> _Measured:
    """Positions of photos; NotGeoreferenced if they are too few, or outside the CRS."""
    names, centres, degrees = _gps(images, metadata)
    if len(names) < LEAST_POSITIONS:
        raise TooFewPositions(f"only {len(names)} photos have GPS" if names else "no photo has GPS")
    known = [metadata[name] for name in names]
    heights = np.array([photo.altitude for photo in known], np.float64)  # unknown: nan
    vertical = ELLIPSOIDAL if all(photo.above_ellipsoid for photo in known) else SEA_LEVEL
    notes = []
    if crs and heights_of(crs).name:
        notes.append(f"heights are not in {heights_of(crs).name}: they are {vertical}, and are not converted")
        crs = horizontal(crs)
    positions, own = map_positions(degrees, heights, crs)
    if crs is not None:
        finite = positions[np.isfinite(positions[:, 0])]
        where = outside(own, finite) if len(finite) else "nowhere"
        if where:
            raise NotGeoreferenced(
                f"the photos' GPS lies {where}, outside the area of {own[:60]}; give another --crs, or leave it out"
            )
    void = sum(photo.void for photo in known)
    if void:
        notes.append(f"the receiver marked the positions of {void} photos as void; they are used")
    std = np.array([photo.gps_std or 3 * (UNKNOWN_STD,) for photo in known])
    guesses = [
        Guess(question, map_positions(other, heights)[0])
        for question, other in (
            ("are latitude and longitude exchanged?", degrees[:, ::-1]),
            (SIGN, degrees * (1, -1)),
            (SIGN, degrees * (-1, 1)),
        )
    ]
    return _Measured(names, centres, positions, guesses, own, vertical, std, tuple(notes))


def _adjusted_to_gps(
    reconstruction: Any,
    images: Sequence[Any],
    measured: _Measured,
    result: Alignment,
    vertical: Vertical,
    offset: NDArray[np.float64],
    keep_focal: bool,
) -> PriorEffect | None:
    """Adjust a reconstruction in its place to the positions that agree with it; None, and nothing
    is done, if they are too few or too bad to be better anywhere than the photos.

    RTK, whose stated accuracy is believed, decides where the scene lies, and makes focal lengths
    and principal points measurable. GPS is taken to be as wrong as it was found, and decides the
    shape alone.
    """
    if not plausible.are_priors(result) or measured.std is None:
        return None
    named, used = {image.name: image for image in images}, result.used
    shown = [named[name] for name in measured.names]
    seen = [image for image, right in zip(shown, used) if right]
    is_rtk = measured.std[used].max(axis=1) <= RTK_STD
    decides = is_rtk.mean() >= MOST_RTK
    along = result.horizontal / np.sqrt(2)
    std = np.where(is_rtk[:, None], measured.std[used], (along, along, np.nan_to_num(result.vertical)))
    # heights by which a scene would be less level than by gimbals or photos are none
    level = np.radians(vertical.degrees) * result.size
    has_height = result.used_heights[used] & (std[:, 2] <= level)
    positions, before = measured.positions[used] - offset, _rotations(images)
    positions[~has_height, 2] = centres_of(seen)[~has_height, 2]
    std[~has_height, 2] = level

    def replaced() -> None:
        """Once more by a similarity, in which gimbals and drifting heights have their weights."""
        ups = np.einsum("vji,vjk,k->vi", _rotations(images), before, result.similarity.rotation @ vertical.up)
        _move(
            reconstruction,
            believed(
                centres_of(shown),
                measured.positions,
                std=measured.std,
                vertical=Vertical.measured(ups.mean(axis=0), vertical.degrees),
            ).similarity,
            offset,
        )

    return adjust_to_positions(
        reconstruction,
        seen,
        positions,
        std,
        has_height,
        keep_focal and not decides,
        decides,
        None if decides else replaced,
    )


def _by_positions(
    images: Sequence[Any], measured: _Measured, result: Alignment, offset: NDArray[np.float64]
) -> tuple[tuple[Residual, ...], str, tuple[float, float]]:
    """The residuals of the positions of photos, the source of the georeference, and the RMS of
    those that were used, along the ground and in height."""
    named, used = {image.name: image for image in images}, result.used
    away = centres_of([named[name] for name in measured.names]) + offset - measured.positions
    found = tuple(
        Residual(name, CONTROL if right else LEFT_OUT, east, north, up if np.isfinite(up) else None)
        for name, right, (east, north, up) in zip(measured.names, used, np.round(away, 4).tolist())
        if np.isfinite(east)
    )
    wrong = [name for name, right in zip(measured.names, used) if not right]
    source = f"GPS of {used.sum()} photos" + (f", without {_listed(wrong)}, whose positions are wrong" if wrong else "")
    ground, height = rms(away[used], result.used_heights[used])
    return found, source, (ground, np.nan if height is None else height)


def _gps(
    images: Sequence[Any], metadata: Mapping[str, PhotoMetadata]
) -> tuple[list[str], NDArray[np.float64], NDArray[np.float64]]:
    """Of the images whose photos have GPS: names, centres [N, 3], latitudes and longitudes [N, 2]."""
    found = [
        (image, metadata[image.name])
        for image in images
        if image.name in metadata and metadata[image.name].latitude is not None
    ]
    return (
        [image.name for image, _ in found],
        centres_of([image for image, _ in found]),
        np.array([(known.latitude, known.longitude) for _, known in found], np.float64).reshape(-1, 2),
    )


def require_near_gps(result: Alignment, images: Sequence[Any], metadata: Mapping[str, PhotoMetadata], crs: str) -> None:
    """NotGeoreferenced if control points place the photos far from their own GPS."""
    names, centres, degrees = _gps(images, metadata)
    if len(names) < LEAST_POSITIONS:
        return
    gps, _ = map_positions(degrees, np.zeros(len(names)), horizontal(crs))
    away = np.linalg.norm((result.similarity(centres) - gps)[:, :2], axis=1)
    # what the CRS cannot represent is on the other side of the earth
    distance = float(np.median(np.nan_to_num(away, nan=2e7)))
    if distance > FARTHEST:
        raise NotGeoreferenced(
            f"--gcp: the ground control points place the photos {distance / 1000:.0f} km from "
            "their GPS: is it the right CRS, and are x and y exchanged?"
        )


def _listed(names: Sequence[str]) -> str:
    """Some names, and how many others there are."""
    rest = len(names) - SHOWN
    return ", ".join(names[:SHOWN]) + (f" and {rest} others" if rest > 0 else "")


def _by_residuals(
    found: Sequence[Residual], lost: Sequence[str], adjusted: bool
) -> tuple[str, tuple[float, float], list[str]]:
    """The source of a georeference by ground control points, its residuals along the ground and in
    height, which are those of the check points if there are any, and notes."""
    rows = {role: [each for each in found if each.role == role] for role in (CONTROL, CHECK, LEFT_OUT)}
    source = f"{len(rows[CONTROL])} ground control points"
    for names, why in (
        (lost, "cannot be located in the photos"),
        ([each.name for each in rows[LEFT_OUT]], "contradict the others"),
    ):
        if names:
            source += f", without {_listed(names)}, which {why}"
    errors, text = _errors(rows[CONTROL])
    notes = [f"{'adjusted to' if adjusted else 'georeferenced by'} {source}: {text}"]
    if rows[CHECK]:
        errors, text = _errors(rows[CHECK])
        notes.append(f"{len(rows[CHECK])} check points, which took no part: {text}")
    elif adjusted:
        notes.append(
            "no check points: the residual of points to which the scene was adjusted does "
            "not show its error; leave some out with --check-point NAME"
        )
    return source, errors, notes


def _errors(rows: Sequence[Residual]) -> tuple[tuple[float, float], str]:
    """Root mean squares along the ground and in height, metres, and a phrase."""
    values = np.array([(each.east, each.north, each.up, each.pixels) for each in rows], np.float64)
    east, north, up, pixels = np.sqrt((values**2).mean(axis=0)).tolist()
    ground = float(np.hypot(east, north))
    return (ground, up), (
        f"residual {ground:.3f} m along the ground, {up:.3f} m in height, {pixels:.1f} pixels in the photos"
    )
