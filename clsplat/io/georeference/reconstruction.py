"""Gives a COLMAP reconstruction its place on the earth: metres, east, north and up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from clsplat.errors import InputError
from clsplat.georeference import Georeference
from clsplat.io.georeference.adjustment import (
    ControlResidual,
    Located,
    adjust,
    locate,
    residuals,
)
from clsplat.io.georeference.control_points import ControlPoint
from clsplat.io.georeference.earth import map_positions
from clsplat.io.metadata import PhotoMetadata
from clsplat.placement.alignment import LEAST_POSITIONS, UP, Alignment, aligned
from clsplat.placement.similarity import rotation_to
from clsplat.placement.up import gimbal_up, up_axis

GIMBAL_DEGREES, CAMERA_DEGREES = 1.0, 3.0  # standard deviations of up by gimbals, and by cameras
LEAST_GIMBALS = 0.5  # share of the photos whose gimbals must be known
UNKNOWN_STD = 3.0  # metres, of GPS that does not state it, among photos that do
LOWEST_GROUND = -30.0  # metres; hardly any land lies lower
SHOWN_NAMES = 5


@dataclass(frozen=True, eq=False)
class Placed:
    """What became of a reconstruction.

    Attributes
    ----------
    georeference : of its new coordinates; None if it is not georeferenced.
    up : float64[3], the unit vector that points up in them.
    notes : lines for the user: what was done, with residuals, or why it was not.
    control : how it shows the ground control points that could be located.
    """

    georeference: Georeference | None
    up: NDArray[np.float64]
    notes: tuple[str, ...]
    control: tuple[ControlResidual, ...] = ()


def place_reconstruction(reconstruction: pycolmap.Reconstruction,
                         metadata: Mapping[str, PhotoMetadata], *, crs: str | None = None,
                         control: Sequence[ControlPoint] = (), up: ArrayLike | None = None,
                         adjusts: bool = False, keep_focal: bool = False) -> Placed:
    """Turn, scale and move a reconstruction in place, so that its axes are east, north and up.

    Ground control points decide if there are any, otherwise GPS. If neither determines the place,
    the reconstruction is only turned, so that the direction (0, -1, 0) points up, as most viewers
    expect.

    Parameters
    ----------
    reconstruction : with the cameras of the photos as they were taken, before undistortion.
    metadata : of the photos, by their names in the reconstruction; some may be missing.
    crs : the coordinate reference system, see `crs.scene_crs`; None: the UTM zone. That of
        `control`, if there is any.
    control : ground control points.
    up : float[3], in the reconstruction, the direction that points up; None: by gimbals or cameras.
    adjusts : whether cameras and points are then adjusted to the control points; otherwise the
        reconstruction keeps its shape.
    keep_focal : whether that adjustment keeps focal lengths.

    Raises
    ------
    InputError : the control points cannot be used.
    """
    images = sorted((image for image in reconstruction.images.values() if image.has_pose),
                    key=lambda image: image.name)
    points = np.array([point.xyz for point in reconstruction.points3D.values()]).reshape(-1, 3)
    up_vector, degrees = _up(images, points, metadata, up)
    located, lost = locate(reconstruction, control)
    used = [item for item in located if not item.point.is_check]
    if control:
        assert crs is not None  # that of the control points
        result = _by_control(used, lost, up_vector, degrees)
        source, kind = "", "the ground control points"
    else:
        known = [(image, metadata[image.name]) for image in images
                 if image.name in metadata and metadata[image.name].latitude is not None]
        kind = "the photos' GPS"
        if len(known) < LEAST_POSITIONS:
            why = "no photo has GPS" if not known else f"only {len(known)} photos have GPS"
            return _turned(reconstruction, up_vector, f"not georeferenced: {why}")
        result, source, crs = _by_gps(known, up_vector, degrees, crs)
    if result is None:
        return _turned(reconstruction, up_vector, f"not georeferenced: {kind} and the "
                       "reconstruction contradict each other, or the places are too close together")
    centres = np.array([image.projection_center() for image in images])
    ground = np.median(result.similarity(points if len(points) else centres), axis=0)
    offset = np.round(ground)
    similarity = result.similarity.moved(-offset)
    reconstruction.transform(pycolmap.Sim3d(
        similarity.scale, pycolmap.Rotation3d(similarity.rotation), similarity.translation))
    level = ([] if result.levelled_by_heights else
             ["heights do not tell which way is up; the "
              f"{'cameras' if degrees == CAMERA_DEGREES else 'gimbals'} do"])
    if control:
        used = (adjust(reconstruction, used, offset, keep_focal) if adjusts else
                [item for item, right in zip(used, result.used & result.used_heights) if right])
        found = residuals(reconstruction, located, used, offset)
        source, residual, notes = _by_residuals(found, lost, adjusts)
        return _placed(crs, offset, source, residual, [*notes, *level], found)
    notes = [f"georeferenced by the {source}: {_residuals(result)}", *level]
    if ground[2] < LOWEST_GROUND:
        notes.append(f"by the photos' altitudes the ground lies at {ground[2]:.0f} m: these are "
                     "probably not heights above sea level; give --gcp if heights matter")
    return _placed(crs, offset, source, result.horizontal, notes)


def _placed(crs: str, offset: NDArray[np.float64], source: str, residual: float,
            notes: Sequence[str], control: tuple[ControlResidual, ...] = ()) -> Placed:
    east, north, height = offset.tolist()
    return Placed(Georeference(crs, (east, north, height), source, residual), UP, tuple(notes),
                  control)


def _by_residuals(found: Sequence[ControlResidual], lost: Sequence[str], adjusted: bool
                  ) -> tuple[str, float, list[str]]:
    """The source of a georeference by ground control points, its residual, which is that of the
    check points if there are any, and notes."""
    parts = {role: [each for each in found if each.role == role]
             for role in ("control", "check", "left out")}
    source = f"{len(parts['control'])} ground control points"
    wrong = [each.name for each in parts["left out"]]
    for names, why in ((lost, "cannot be located in the photos"), (wrong, "contradict the others")):
        if names:
            source += f", without {_names(names)}, which {why}"
    notes = [f"{'adjusted to' if adjusted else 'georeferenced by'} {source}: "
             f"{_control_residuals(parts['control'])}"]
    if parts["check"]:
        notes.append(f"{len(parts['check'])} check points, which took no part: "
                     f"{_control_residuals(parts['check'])}")
    elif adjusted:
        notes.append("no check points: the residual of points to which the scene was adjusted does "
                     "not tell its error; leave some out with --check-point NAME")
    judged = parts["check"] or parts["control"]
    return source, _rms([(each.east, each.north) for each in judged]), notes


def _control_residuals(items: Sequence[ControlResidual]) -> str:
    return (f"residual {_rms([(each.east, each.north) for each in items]):.3f} m along the ground, "
            f"{_rms([(each.up,) for each in items]):.3f} m in height, "
            f"{np.sqrt(np.mean([each.pixels**2 for each in items])):.1f} pixels in the photos")


def _rms(rows: Sequence[Sequence[float]]) -> float:
    """The root mean square of the lengths of vectors."""
    return float(np.sqrt(np.mean(np.sum(np.square(rows), axis=1))))


def _residuals(result: Alignment) -> str:
    text = f"residual {result.horizontal:.2f} m along the ground"
    if np.isfinite(result.vertical):
        text += f", {result.vertical:.2f} m in height"
    return text


def _up(images: Sequence[Any], points: NDArray[np.float64],
        metadata: Mapping[str, PhotoMetadata], given: ArrayLike | None
        ) -> tuple[NDArray[np.float64], float]:
    """The direction that points up, and its standard deviation in degrees."""
    if given is not None:
        return np.asarray(given, np.float64), GIMBAL_DEGREES
    rotations = np.array([_upright(image, metadata.get(image.name)) for image in images])
    gimbals = [(rotation, known.gimbal_pitch, known.gimbal_roll)
               for rotation, known in ((rotation, metadata.get(image.name))
                                       for rotation, image in zip(rotations, images))
               if known is not None and known.orientation == 1
               and known.gimbal_pitch is not None and known.gimbal_roll is not None]
    if gimbals and len(gimbals) >= LEAST_GIMBALS * len(images):
        by_gimbals = gimbal_up(*(np.array(values) for values in zip(*gimbals)))
        if by_gimbals is not None:
            return by_gimbals, GIMBAL_DEGREES
    return up_axis(rotations, points), CAMERA_DEGREES


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


def _by_gps(known: Sequence[tuple[Any, PhotoMetadata]], up: NDArray[np.float64], degrees: float,
            crs: str | None) -> tuple[Alignment | None, str, str]:
    """The alignment with the positions of photos, what it is from, and the CRS."""
    places = np.array([(photo.latitude, photo.longitude, photo.altitude) for _, photo in known],
                      np.float64)  # an unknown altitude becomes nan
    positions, crs = map_positions(places[:, 0], places[:, 1], places[:, 2], crs)
    std = None
    if any(photo.gps_std is not None for _, photo in known):
        std = np.array([photo.gps_std or 3 * (UNKNOWN_STD,) for _, photo in known])
    finite = np.isfinite(positions[:, :2]).all(axis=1)
    result = aligned(np.array([image.projection_center() for image, _ in known])[finite],
                     positions[finite], up, up_degrees=degrees,
                     std=None if std is None else std[finite])
    if result is None:
        return None, "", crs
    used = np.zeros(len(known), bool)
    used[finite] = result.used
    source = f"GPS of {used.sum()} photos"
    wrong = [image.name for (image, _), right in zip(known, used) if not right]
    if wrong:
        source += f", without {_names(wrong)}, whose positions are wrong"
    return result, source, crs


def _names(names: Sequence[str]) -> str:
    rest = len(names) - SHOWN_NAMES
    return ", ".join(names[:SHOWN_NAMES]) + (f" and {rest} others" if rest > 0 else "")


def _by_control(located: Sequence[Located], lost: Sequence[str], up: NDArray[np.float64],
                degrees: float) -> Alignment | None:
    """The alignment with ground control points."""
    count = len(located) + len(lost)
    if len(located) < LEAST_POSITIONS:
        missing = f" (not located: {_names(lost)})" if lost else ""
        raise InputError(f"--gcp: {len(located)} of {count} ground control points can be "
                         f"located in the photos, and {LEAST_POSITIONS} are needed{missing}; mark "
                         "each in two photos or more, by the names and in the pixels of the photos "
                         "that were reconstructed")
    return aligned(np.array([item.place for item in located]),
                   np.array([item.point.position for item in located]), up, up_degrees=degrees,
                   independent_heights=len(located))


def _turned(reconstruction: pycolmap.Reconstruction, up: NDArray[np.float64], why: str) -> Placed:
    target = np.array([0.0, -1.0, 0.0])
    rotation = rotation_to(up / np.linalg.norm(up), target)
    reconstruction.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(rotation), np.zeros(3)))
    return Placed(None, target, (why,))
