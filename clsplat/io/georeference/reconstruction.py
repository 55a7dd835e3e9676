"""Gives a COLMAP reconstruction its place on the earth: metres, east, north and up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from clsplat.georeference import CHECK, CONTROL, LEFT_OUT, Georeference, Residual
from clsplat.io.georeference.adjustment import NotGeoreferenced, adjust, locate, residuals
from clsplat.io.georeference.control_points import ControlPoint
from clsplat.io.georeference.measured import (
    Measured,
    by_control,
    by_gps,
    listed,
    require_near_gps,
)
from clsplat.io.photos.metadata import PhotoMetadata
from clsplat.placement.alignment import INDEPENDENT_HEIGHTS, Alignment
from clsplat.placement.plausible import Implausible, believed, doubts
from clsplat.placement.similarity import Similarity, rotation_to
from clsplat.placement.up import CAMERA_DEGREES, UP, Vertical, gimbal_up

LEAST_GIMBALS = 0.5  # share of the photos whose gimbals must be known
LOWEST_GROUND = -30.0  # metres; hardly any land lies lower


@dataclass(frozen=True, eq=False)
class Placed:
    """What became of a reconstruction.

    Attributes
    ----------
    georeference : of its new coordinates; None if it is not georeferenced.
    up : float64[3], the unit vector that points up in them.
    notes : lines for the user: what was done, with residuals, or why it was not.
    warnings : sentences that a user must see, even if all else is quiet.
    """

    georeference: Georeference | None
    up: NDArray[np.float64]
    notes: tuple[str, ...]
    warnings: tuple[str, ...] = ()


def place_reconstruction(reconstruction: pycolmap.Reconstruction,
                         metadata: Mapping[str, PhotoMetadata], *, crs: str | None = None,
                         control: Sequence[ControlPoint] = (), vertical: str = "",
                         up: ArrayLike | None = None, adjusts: bool = False,
                         keep_focal: bool = False) -> Placed:
    """Turn, scale and move a reconstruction in place, so that its axes are east, north and up.

    Ground control points decide if there are any, otherwise GPS.

    Parameters
    ----------
    reconstruction : with the cameras of the photos as they were taken, before undistortion.
    metadata : of the photos, by their names in the reconstruction; some may be missing.
    crs : the coordinate reference system, see `crs.scene_crs`; None: the UTM zone. That of
        `control`, if there is any.
    control, vertical : ground control points, and what their heights count from.
    up : float[3], in the reconstruction, the direction that points up; None: by gimbals or cameras.
    adjusts : whether cameras and points are then adjusted to the control points; otherwise the
        reconstruction keeps its shape.
    keep_focal : whether that adjustment keeps focal lengths.

    Raises
    ------
    NotGeoreferenced : nothing determines the place, or the result cannot be right. After
        `adjusts` the reconstruction may have changed, and is of no use.
    """
    images, points = _content(reconstruction)
    known_up = _vertical(images, points, metadata, up)
    located, lost = locate(reconstruction, control)
    used = [item for item in located if not item.point.is_check]
    measured = by_control(used, lost, crs or "", vertical) if control else by_gps(
        images, metadata, crs)
    result = _believed(measured, known_up, bool(control))
    if control:
        require_near_gps(result, images, metadata, measured.crs)
    centres = np.array([image.projection_center() for image in images])
    ground = np.median(result.similarity(points if len(points) else centres), axis=0)
    offset = np.round(ground)
    _transform(reconstruction, Similarity(
        result.similarity.scale, result.similarity.rotation,
        result.similarity.translation - offset))
    if control:
        used = (adjust(reconstruction, used, offset, keep_focal) if adjusts else
                [item for item, right in zip(used, result.used & result.used_heights) if right])
        found = residuals(reconstruction, located, used, offset)
        source, errors, notes = _by_residuals(found, lost, adjusts)
        warnings = doubts(result, measured.positions, known_up, "the surveyed area",
                          residuals=errors, heights_count=True)
    else:
        wrong = [name for name, right in zip(measured.names, result.used) if not right]
        without = f", without {listed(wrong)}, whose positions are wrong" if wrong else ""
        source, errors = f"GPS of {result.used.sum()} photos{without}", (
            result.horizontal, result.vertical)
        found = _missed(measured, result)
        height = f", {result.vertical:.2f} m in height" * bool(np.isfinite(result.vertical))
        notes = [f"georeferenced by the {source}: residual {result.horizontal:.2f} m along the "
                 f"ground{height}"]
        warnings = doubts(result, measured.positions, known_up, "the flight")
        if ground[2] < LOWEST_GROUND:
            warnings.append(f"by the photos' altitudes the ground lies at {ground[2]:.0f} m: these "
                            "are probably not heights above sea level; give --gcp if heights "
                            "matter")
    notes += measured.notes
    if not result.levelled_by_heights:
        source_of_up = "cameras" if known_up.degrees == CAMERA_DEGREES else "gimbals"
        notes.append(f"heights do not show which way is up; the {source_of_up} do")
    east, north, height = offset.tolist()
    return Placed(Georeference(
        measured.crs, (east, north, height), source, errors[0], "gcp" if control else "gps",
        round(result.size, 3), measured.vertical, found, tuple(warnings)), UP,
        tuple(notes), tuple(warnings))


def turned(reconstruction: pycolmap.Reconstruction, metadata: Mapping[str, PhotoMetadata],
           why: NotGeoreferenced) -> Placed:
    """Turn a reconstruction that has no place in place, so that the direction (0, -1, 0) points up,
    as most viewers expect.

    Parameters
    ----------
    reconstruction, metadata : as for `place_reconstruction`.
    why : it has no place.
    """
    target = np.array([0.0, -1.0, 0.0])
    rotation = rotation_to(_vertical(*_content(reconstruction), metadata, None).up, target)
    _transform(reconstruction, Similarity(1.0, rotation, np.zeros(3)))
    notes = (f"not georeferenced: {why}",)
    return Placed(None, target, notes, () if why.expected else notes)


def _transform(reconstruction: pycolmap.Reconstruction, similarity: Similarity) -> None:
    reconstruction.transform(pycolmap.Sim3d(
        similarity.scale, pycolmap.Rotation3d(similarity.rotation), similarity.translation))


def _content(reconstruction: pycolmap.Reconstruction) -> tuple[list[Any], NDArray[np.float64]]:
    """The images with a pose, by name, and the points [N, 3]."""
    images = sorted((image for image in reconstruction.images.values() if image.has_pose),
                    key=lambda image: image.name)
    return images, np.array(
        [point.xyz for point in reconstruction.points3D.values()]).reshape(-1, 3)


def _believed(measured: Measured, known_up: Vertical, is_control: bool) -> Alignment:
    try:
        return believed(
            measured.places, measured.positions, known_up, measured.guesses, std=measured.std,
            independent_heights=len(measured.names) if is_control else INDEPENDENT_HEIGHTS,
            heights_count=is_control)
    except Implausible as error:
        kind = "--gcp: the ground control points" if is_control else "the photos' GPS positions"
        cure = "" if str(error).endswith("?") else "; check the coordinates" + (
            ", the CRS and the marks" if is_control else "")
        raise NotGeoreferenced(f"{kind} {error}{cure}") from None


def _missed(measured: Measured, result: Alignment) -> tuple[Residual, ...]:
    away = np.round(result.similarity(measured.places) - measured.positions, 4)
    return tuple(
        Residual(name, CONTROL if right else LEFT_OUT, east, north,
                 up if np.isfinite(up) else None)
        for name, right, (east, north, up) in zip(measured.names, result.used, away.tolist())
        if np.isfinite(east))


def _by_residuals(found: Sequence[Residual], lost: Sequence[str], adjusted: bool
                  ) -> tuple[str, tuple[float, float], list[str]]:
    """The source of a georeference by ground control points, its residuals along the ground and in
    height, which are those of the check points if there are any, and notes."""
    parts = {role: [each for each in found if each.role == role]
             for role in (CONTROL, CHECK, LEFT_OUT)}
    source = f"{len(parts[CONTROL])} ground control points"
    wrong = [each.name for each in parts[LEFT_OUT]]
    for names, why in ((lost, "cannot be located in the photos"), (wrong, "contradict the others")):
        if names:
            source += f", without {listed(names)}, which {why}"
    errors = {role: (_rms([(each.east, each.north) for each in rows]),
                     _rms([(each.up,) for each in rows]), _rms([(each.pixels,) for each in rows]))
              for role, rows in parts.items() if rows}
    text = "residual {:.3f} m along the ground, {:.3f} m in height, {:.1f} pixels in the photos"
    notes = [f"{'adjusted to' if adjusted else 'georeferenced by'} {source}: "
             f"{text.format(*errors[CONTROL])}"]
    if CHECK in errors:
        notes.append(f"{len(parts[CHECK])} check points, which took no part: "
                     f"{text.format(*errors[CHECK])}")
    elif adjusted:
        notes.append("no check points: the residual of points to which the scene was adjusted does "
                     "not show its error; leave some out with --check-point NAME")
    return source, errors.get(CHECK, errors[CONTROL])[:2], notes


def _rms(rows: Sequence[Sequence[float | None]]) -> float:
    """The root mean square of the lengths of vectors."""
    return float(np.sqrt(np.mean(np.sum(np.square(np.array(rows, np.float64)), axis=1))))


def _vertical(images: Sequence[Any], points: NDArray[np.float64],
              metadata: Mapping[str, PhotoMetadata], given: ArrayLike | None) -> Vertical:
    """What the user, the gimbals, or else the cameras and points show of the vertical."""
    if given is not None:
        return Vertical.measured(given)
    known = [metadata.get(image.name) for image in images]
    rotations = np.array([_upright(*pair) for pair in zip(images, known)])
    gimbals = [(rotation, photo.gimbal_pitch, photo.gimbal_roll)
               for rotation, photo in zip(rotations, known)
               if photo is not None and photo.orientation == 1
               and photo.gimbal_pitch is not None and photo.gimbal_roll is not None]
    if gimbals and len(gimbals) >= LEAST_GIMBALS * len(images):
        by_gimbals = gimbal_up(*(np.array(values) for values in zip(*gimbals)))
        if by_gimbals is not None:
            return Vertical.measured(by_gimbals)
    return Vertical.by_cameras(rotations, points)


def _upright(image: Any, known: PhotoMetadata | None) -> NDArray[np.float64]:
    """The rotation float64[3, 3] from the world to the camera of the photo as EXIF turns it."""
    rotation: NDArray[np.float64] = image.cam_from_world().rotation.matrix()
    if known is None:
        return rotation
    # `clsplat sfm` turns pixels and camera itself, so the original's metadata no longer hold
    is_turned = (image.camera.width > image.camera.height) != (known.width > known.height)
    degrees = 0 if is_turned else 90 * known.quarter_turns
    turn: NDArray[np.float64] = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    return turn @ rotation
