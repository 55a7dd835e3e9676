"""Small corrections of camera poses: what they do to a camera, and the motion that all have in
common."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from clsplat.camera import Camera


@dataclass(frozen=True, eq=False)
class Correction:
    """How the pose of a camera is corrected.

    Attributes
    ----------
    turn : float64[3], radians; a rotation vector in the axes of the given camera, by which all that
        the camera sees turns about its centre.
    shift : float64[3], world units; by which its centre moves, in the axes of the given camera.
    """

    turn: NDArray[np.float64]
    shift: NDArray[np.float64]

    def applied(self, camera: Camera) -> Camera:
        """The camera with the corrected pose."""
        return camera.moved(self.turn, self.shift)

    @property
    def degrees(self) -> float:
        """The angle of the turn, degrees."""
        return float(np.degrees(np.linalg.norm(self.turn)))


def correction_between(given: Camera, wanted: Camera) -> Correction:
    """The correction that makes the pose of one camera that of another, in the same world."""
    turn = scipy.spatial.transform.Rotation.from_matrix(wanted.rotation @ given.rotation.T).as_rotvec()
    return Correction(turn, given.rotation @ (wanted.position - given.position))


def typical_depth(cameras: Sequence[Camera], points: ArrayLike) -> float:
    """World units: the median over cameras of the median depth of the points float[N, 3] that they
    see; 1 if they see none."""
    medians = [np.median(camera.project(points)[1][seen]) for camera in cameras if (seen := camera.shows(points)).any()]
    return float(np.median(medians)) if medians else 1.0


def without_common_motion(given: Sequence[Camera], corrections: Sequence[Correction], depth: float) -> list[Correction]:
    """Corrections after the mean rigid motion of all cameras is taken out of them.

    A world in which the gaussians and all cameras have moved alike gives the same photos. So no
    photo shows that motion, but held-out views, blocks and maps would be displaced by it. It is the
    one that explains the corrections best by least squares, where a turn counts as much as the
    shift that it makes at a distance `depth`, and to first order in the corrections.

    Parameters
    ----------
    given, corrections : the cameras as they were given, at least one, and their corrections.
    depth : world units.
    """
    positions = np.array([camera.position for camera in given])
    middle = positions.mean(axis=0)
    rows, values = [], []
    for camera, correction, arm in zip(given, corrections, positions - middle):
        back = camera.rotation.T
        # all that turns by a small vector a about the middle, and shifts by b: the centres by
        # a x arm + b, and what a camera sees by -R a
        rows += [np.hstack([-np.eye(3) * depth, np.zeros((3, 3))]), np.hstack([np.cross(arm, np.eye(3)), np.eye(3)])]
        values += [back @ correction.turn * depth, back @ correction.shift]
    a, b = np.linalg.lstsq(np.vstack(rows), np.concatenate(values), rcond=None)[0].reshape(2, 3)
    turned = scipy.spatial.transform.Rotation.from_rotvec(a).as_matrix()
    result = []
    for camera, correction in zip(given, corrections):
        moved = correction.applied(camera)
        rotation = moved.rotation @ turned
        position = middle + turned.T @ (moved.position - middle - b)
        result.append(correction_between(camera, replace(moved, rotation=rotation, translation=-rotation @ position)))
    return result
