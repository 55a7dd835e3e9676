"""Ground control points in a reconstruction: where their marks are, and bundle adjustment to them.

A similarity leaves a reconstruction as it is bent: a wrong focal length or distortion makes a bowl
of flat ground, and drift over long strips a wave. So the bundle is adjusted once more, with the
control points as points whose coordinates are held, each observed where it was marked. A control
point whose marks then still miss it has wrong coordinates, and is left out (Baarda's data snooping,
the worst first). Check points take no part, so they show how right the result is.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.georeference import CHECK, CONTROL, LEFT_OUT, Residual
from clsplat.io.georeference.control_points import ControlPoint
from clsplat.placement.alignment import LEAST_POSITIONS

MARK_TOLERANCE = 20.0  # pixels by which a mark may miss the point that the others show
ADJUSTED_TOLERANCE = 8.0  # pixels, RMS of the marks of a point to which the bundle is adjusted
LEAST_ANGLE = np.radians(1.0)  # between rays; from closer ones the distance is not known


class NotGeoreferenced(InputError):
    """Why a reconstruction has no place on the earth; `expected` if nothing is wrong, and there are
    simply too few positions."""

    def __init__(self, why: str, expected: bool = False) -> None:
        super().__init__(why)
        self.expected = expected


@dataclass(frozen=True, eq=False)
class Located:
    """A ground control point with the marks, (id of a pycolmap.Image, x, y), that agree with each
    other, and the place where their rays meet in the reconstruction."""

    point: ControlPoint
    marks: tuple[tuple[int, float, float], ...]
    place: NDArray[np.float64]


def check_marks(control: Iterable[ControlPoint], photos: Collection[str]) -> None:
    """InputError if no mark of ground control points is in one of these photos, by name, or if the
    name of one, without folders, is that of several photos."""
    full: dict[str, list[str]] = {}  # a list may leave out the folders
    for name in photos:
        full.setdefault(name.rpartition("/")[2], []).append(name)
    marked = [name for point in control for name, _, _ in point.marks]
    if marked and not any(name in photos or name in full for name in marked):
        raise InputError(f"--gcp: no photo has a name of those in the file, such as {marked[0]}; "
                         "use the names of the photos, with their suffix")
    for name in marked:
        if name not in photos and len(full.get(name, ())) > 1:
            first, second, *_ = sorted(full[name])
            raise InputError(f"--gcp: {name} may be {first} or {second}; write the photos of the "
                             "file with their folders")


def locate(reconstruction: Any, control: Iterable[ControlPoint]) -> tuple[list[Located], list[str]]:
    """Locate ground control points by their marks, which `check_marks` has passed: the points that
    two or more marks locate, and the names of the others."""
    named = {image.name: image for image in reconstruction.images.values() if image.has_pose}
    named = {name.rpartition("/")[2]: image for name, image in named.items()} | named
    located, lost = [], []
    for point in control:
        marks = [(named[name], x, y) for name, x, y in point.marks if name in named]
        found = _located(reconstruction, point, marks, MARK_TOLERANCE)
        if found is None:
            lost.append(point.name)
        else:
            located.append(found)
    return located, lost


def _located(reconstruction: Any, point: ControlPoint, marks: Sequence[tuple[Any, float, float]],
             tolerance_pixels: float) -> Located | None:
    origins, directions, radians, kept = [], [], [], []  # radians: of a pixel
    for image, x, y in marks:
        camera = reconstruction.cameras[image.camera_id]
        if not (0 <= x <= camera.width and 0 <= y <= camera.height):
            continue
        ray = image.cam_from_world().rotation.matrix().T @ np.append(
            camera.cam_from_img(np.array([x, y])), 1.0)
        origins.append(image.projection_center())
        directions.append(ray / np.linalg.norm(ray))
        radians.append(1 / camera.mean_focal_length())
        kept.append((image.image_id, x, y))
    if len(origins) < 2:
        return None
    found = intersection(np.array(origins), np.array(directions), tolerance_pixels * max(radians))
    return found and Located(
        point, tuple(mark for mark, right in zip(kept, found[1]) if right), found[0])


def intersection(origins: NDArray[np.float64], directions: NDArray[np.float64],
                 tolerance: float) -> tuple[NDArray[np.float64], NDArray[np.bool_]] | None:
    """The point nearest to most of several rays.

    Parameters
    ----------
    origins, directions : [K, 3]; camera centres, and unit vectors.
    tolerance : radians, by which a ray may miss the point; rays that miss it by more are left out,
        the worst first.

    Returns
    -------
    The point [3], and which rays it comes from as bool[K]; None if there are not two rays from
    sufficiently different directions that meet, or the point is behind a camera.
    """
    used: NDArray[np.bool_] = np.all(np.isfinite(directions), axis=1)
    while used.sum() >= 2:
        projectors = np.eye(3) - directions[used, :, None] * directions[used, None, :]
        matrix = projectors.sum(axis=0)
        # for two rays with an angle a between them, the least eigenvalue is 1 - cos a
        if np.linalg.eigvalsh(matrix)[0] < 1 - np.cos(LEAST_ANGLE):
            return None
        point: NDArray[np.float64] = np.linalg.solve(
            matrix, np.einsum("kij,kj->i", projectors, origins[used]))
        towards = point - origins
        misses = np.arctan2(np.linalg.norm(np.cross(towards, directions), axis=1),
                            (towards * directions).sum(axis=1))
        worst = int(np.argmax(np.where(used, misses, -1.0)))
        if misses[worst] <= tolerance:
            return point, used
        used[worst] = False
    return None


def adjust(reconstruction: Any, located: Sequence[Located], offset: NDArray[np.float64],
           keep_focal: bool) -> list[Located]:
    """Adjust cameras and points of a reconstruction, nearly in its place, so that control points
    lie where they are known to; returns those that were used, as the others are wrong.

    Parameters
    ----------
    located : the control points, none of which is a check point. NotGeoreferenced if fewer than
        three of them agree with the photos.
    offset : float64[3], map coordinates of the reconstruction's origin.
    keep_focal : whether focal lengths are known better than from the photos.
    """
    used = list(located)
    while len(used) >= LEAST_POSITIONS:
        _adjust(reconstruction, used, offset, keep_focal)
        misses = [_mark_error(reconstruction, item, offset) for item in used]
        worst = int(np.argmax(misses))
        if misses[worst] <= ADJUSTED_TOLERANCE:
            return used
        del used[worst]
    raise NotGeoreferenced(
        f"--gcp: fewer than {LEAST_POSITIONS} ground control points agree with the photos; "
        "check coordinates, their order (X is east), the CRS and the marks")


def _adjust(reconstruction: Any, located: Sequence[Located], offset: NDArray[np.float64],
            keep_focal: bool) -> None:
    config, added = pycolmap.BundleAdjustmentConfig(), []
    for image in reconstruction.images.values():
        if image.has_pose:
            config.add_image(image.image_id)
    for item in located:
        track = pycolmap.Track()
        for number, x, y in item.marks:
            points2d = reconstruction.images[number].points2D
            points2d.append(pycolmap.Point2D(np.array([x, y])))
            track.add_element(number, len(points2d) - 1)
        added.append(reconstruction.add_point3D(np.array(item.point.position) - offset, track))
        config.add_constant_point(added[-1])
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary, options.refine_focal_length = False, not keep_focal
    # with squared errors, a single point with wrong coordinates would bend a small block to itself
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    try:
        pycolmap.create_default_bundle_adjuster(options, config, reconstruction).solve()
    finally:
        for number in added:  # they are no points of the scene
            reconstruction.delete_point3D(number)
    reconstruction.update_point_3d_errors()


def _mark_error(reconstruction: Any, item: Located, offset: NDArray[np.float64]) -> float:
    """RMS distance of the marks of a control point from its known place, pixels."""
    place = np.array(item.point.position) - offset
    errors = []
    for number, x, y in item.marks:
        pixel = reconstruction.images[number].project_point(place)
        errors.append(np.inf if pixel is None else float(np.hypot(pixel[0] - x, pixel[1] - y)))
    return float(np.sqrt(np.mean(np.square(errors))))


def residuals(reconstruction: Any, located: Iterable[Located], used: Iterable[Located],
              offset: NDArray[np.float64]) -> tuple[Residual, ...]:
    """How a georeferenced reconstruction shows ground control points, of which those that were used
    are neither check points nor wrong."""
    names, result = {item.point.name for item in used}, []
    for item in located:
        point = item.point
        marks = [(reconstruction.images[number], x, y) for number, x, y in item.marks]
        found = _located(reconstruction, point, marks, np.inf)
        if found is not None:
            role = CHECK if point.is_check else CONTROL if point.name in names else LEFT_OUT
            east, north, up = np.round(found.place + offset - point.position, 4).tolist()
            pixels = round(_mark_error(reconstruction, item, offset), 2)
            result.append(Residual(point.name, role, east, north, up, pixels))
    return tuple(result)
