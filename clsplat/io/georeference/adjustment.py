"""Ground control points in a reconstruction: where their marks are, and bundle adjustment to them.

A similarity leaves a reconstruction as it is bent: a wrong focal length or distortion makes a bowl
of flat ground, and drift over long strips a wave. So the bundle is adjusted once more, with the
control points as points whose coordinates are held, each observed where it was marked. A control
point whose marks then still miss it has wrong coordinates, and is left out (Baarda's data snooping,
the worst first). Check points take no part, so they show how right the result is.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from itertools import compress
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.georeference import CHECK, CONTROL, LEFT_OUT, Residual
from clsplat.io.georeference.control_points import ControlPoint
from clsplat.placement.alignment import LEAST_POSITIONS
from clsplat.placement.plausible import NotGeoreferenced

MARK_TOLERANCE = 20.0  # pixels by which a mark may miss the point that the others show
ADJUSTED_TOLERANCE = 8.0  # pixels, RMS of the marks of a point to which the bundle is adjusted
LEAST_ANGLE = np.radians(1.0)  # between rays; from closer ones the distance is not known
Mark = tuple[int, float, float]  # id of a pycolmap.Image, and pixels


@dataclass(frozen=True, eq=False)
class Located:
    """A ground control point with the marks that agree with each other, and the place float64[3]
    in the reconstruction where their rays meet."""

    point: ControlPoint
    marks: tuple[Mark, ...]
    place: NDArray[np.float64]


def check_marks(control: Iterable[ControlPoint], photos: Collection[str]) -> None:
    """InputError if no mark of ground control points is in one of these photos, by name, or if the
    name of one, without folders, is that of several photos."""
    full = Counter(name.rpartition("/")[2] for name in photos)  # a list may leave out the folders
    marked = [name for point in control for name, _, _ in point.marks]
    if marked and not any(name in photos or name in full for name in marked):
        raise InputError(
            f"--gcp: no photo has a name of those in the file, such as {marked[0]}; "
            "use the names of the photos, with their suffix"
        )
    for name in marked:
        if name not in photos and full[name] > 1:
            raise InputError(
                f"--gcp: {full[name]} photos have the name {name}; write the photos of the file with their folders"
            )


def locate(reconstruction: Any, control: Iterable[ControlPoint]) -> tuple[list[Located], list[str]]:
    """Locate ground control points by their marks, which `check_marks` has passed: the points that
    two or more marks locate, and the names of the others."""
    named = {image.name: image for image in reconstruction.images.values() if image.has_pose}
    named = {name.rpartition("/")[2]: image for name, image in named.items()} | named
    located, lost = [], []
    for point in control:
        marks = [
            (named[name].image_id, x, y)
            for name, x, y in point.marks
            if name in named and 0 <= x <= named[name].camera.width and 0 <= y <= named[name].camera.height
        ]
        found = _located(reconstruction, point, marks, MARK_TOLERANCE)
        if found is None:
            lost.append(point.name)
        else:
            located.append(found)
    return located, lost


def _located(reconstruction: Any, point: ControlPoint, marks: Sequence[Mark], tolerance: float) -> Located | None:
    """The point by most of its marks, each within a tolerance in pixels; None if there are not two
    whose rays meet at an angle."""
    if len(marks) < 2:
        return None
    images = [reconstruction.images[number] for number, _, _ in marks]
    options = pycolmap.EstimateTriangulationOptions(min_tri_angle=LEAST_ANGLE)
    options.ransac.max_error = min(  # radians
        np.pi, tolerance / min(image.camera.mean_focal_length() for image in images)
    )
    options.ransac.random_seed = 0
    found = pycolmap.estimate_triangulation(
        [(x, y) for _, x, y in marks],
        [image.cam_from_world() for image in images],
        [image.camera for image in images],
        options,
    )
    return None if found is None else Located(point, tuple(compress(marks, found["inliers"])), found["xyz"])


def adjust(
    reconstruction: Any, located: Sequence[Located], offset: NDArray[np.float64], keep_focal: bool
) -> list[Located]:
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
        "check coordinates, their order (X is east), the CRS and the marks"
    )


def _adjust(reconstruction: Any, located: Sequence[Located], offset: NDArray[np.float64], keep_focal: bool) -> None:
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
    pycolmap.create_default_bundle_adjuster(options, config, reconstruction).solve()
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


def residuals(
    reconstruction: Any, located: Iterable[Located], used: Iterable[Located], offset: NDArray[np.float64]
) -> tuple[Residual, ...]:
    """How a georeferenced reconstruction shows ground control points, of which those that were used
    are neither check points nor wrong."""
    names, result = {item.point.name for item in used}, []
    for item in located:
        point, found = item.point, _located(reconstruction, item.point, item.marks, np.inf)
        if found is not None:
            role = CHECK if point.is_check else CONTROL if point.name in names else LEFT_OUT
            east, north, up = np.round(found.place + offset - point.position, 4).tolist()
            pixels = round(_mark_error(reconstruction, item, offset), 2)
            result.append(Residual(point.name, role, east, north, up, pixels))
    return tuple(result)
