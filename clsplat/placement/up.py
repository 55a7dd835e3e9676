"""Which way is up in a scene, by its cameras and points, or by the gimbals of its cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

UP = np.array([0.0, 0.0, 1.0])  # in the axes east, north, up

LEVEL_NOISE = 3e-4  # square of a degree in radians: nothing is known to be more level than that
ITERATIONS = 20
MOST_SAMPLED = 20_000  # points
UNDETERMINED = 0.3  # ratio of spreads beyond which a direction is not known
MOST_TILT = 30.0  # degrees between up in a result and a direction that is known to be up
CLEAR = 0.25  # cosine: the mean top of photos that shows which end of an axis is up
CAMERA_DEGREES, GIMBAL_DEGREES = 3.0, 1.0  # standard deviations of up by cameras, and measured
GIMBAL_SPREAD = 5.0  # degrees, median; gimbals that differ by more show nothing


@dataclass(frozen=True, eq=False)
class Vertical:
    """What is known of the vertical in a reconstruction."""

    up: NDArray[np.float64]  # float64[3], the unit vector that most probably points up
    degrees: float  # its standard deviation
    # float64[K, 3], directions of which one points up; none if nothing determines it
    known: NDArray[np.float64]
    # float64[2, 3], the means over the photos of the direction of their top, and of the one away
    # from which they look; None if `up` was measured
    looks: NDArray[np.float64] | None = None

    @classmethod
    def measured(cls, up: ArrayLike, degrees: float = GIMBAL_DEGREES) -> Vertical:
        """By gimbals, or given by the user."""
        vector = np.asarray(up, np.float64)
        unit = vector / np.linalg.norm(vector)
        return cls(unit, degrees, unit[None])

    @classmethod
    def by_cameras(cls, rotations: NDArray[np.float64], points: NDArray[np.float64]) -> Vertical:
        """Estimated by cameras and points.

        There are two candidates: the direction most perpendicular to the rows of the images, since
        photographers keep the horizon level (Brown and Lowe 2007, section 5), and the normal of the
        plane through the points. The better determined one is taken as up. Its sign follows the
        tops of the images or, if they look along it, the direction away from which they look. A
        minority of turned photos, or of points on buildings and trees, has little influence. On a
        facade the plane of the points stands upright, so that both candidates may be up.

        Parameters
        ----------
        rotations, points : [V, 3, 3], world to camera; [N, 3], world, the sparse points.
        """
        looks: NDArray[np.float64] = -rotations[:, 1:].mean(axis=0)
        found = [_least_spread(rotations[:, 0])]
        if len(points):
            found.append(_least_spread(_centred(points)))
        found = sorted(
            ((axis if _sense(looks, axis) >= 0 else -axis, ratio) for axis, ratio in found),
            key=lambda candidate: candidate[1],
        )
        known = [direction for direction, ratio in found if ratio < UNDETERMINED]
        return cls(found[0][0], CAMERA_DEGREES, np.array(known).reshape(-1, 3), looks)

    def tilt(self, rotation: NDArray[np.float64]) -> float:
        """Degrees between up and the nearest direction that is known, once a rotation has turned
        the reconstruction into east, north, up; 0 if none is."""
        if not len(self.known):
            return 0.0
        return float(np.degrees(np.arccos(np.clip((self.known @ rotation.T)[:, 2].max(), -1, 1))))

    def stands(self, rotation: NDArray[np.float64]) -> bool:
        """Whether the turned reconstruction is neither upside down nor tilted far."""
        on_its_head = self.looks is not None and _sense(self.looks @ rotation.T, UP) < -CLEAR
        return not on_its_head and self.tilt(rotation) <= MOST_TILT


def _sense(looks: NDArray[np.float64], axis: NDArray[np.float64]) -> float:
    """Above 0 if an axis points up, by the tops of the photos or, if these do not show it, since
    photos that look along it look down."""
    top, away = looks @ axis
    return float(top if abs(top) > CLEAR else away)


def gimbal_up(
    rotations: NDArray[np.float64], pitches: NDArray[np.float64], rolls: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """The unit vector [3] that points up by the angles of gimbals, which measure gravity; None if
    they contradict each other.

    Parameters
    ----------
    rotations : [V, 3, 3], world to camera.
    pitches, rolls : [V], degrees; a pitch is -90 if the camera looks straight down, a roll is
        clockwise.
    """
    pitch, roll = np.radians(pitches), np.radians(rolls)
    in_camera = np.stack([-np.cos(pitch) * np.sin(roll), -np.cos(pitch) * np.cos(roll), np.sin(pitch)], axis=1)
    ups = np.einsum("vij,vi->vj", rotations, in_camera)
    up = np.median(ups, axis=0)
    length = float(np.linalg.norm(up))
    if not length > 0:
        return None
    angles = np.degrees(np.arccos(np.clip(ups @ up / length, -1, 1)))
    return up / length if np.median(angles) <= GIMBAL_SPREAD else None


def _least_spread(vectors: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """The direction [3] along which vectors [N, 3] have the least sum of lengths (least squares,
    reweighted), and the ratio of the spread along it to that along the next one."""
    weights = np.ones(len(vectors))
    noise = LEVEL_NOISE * float((vectors**2).sum(axis=1).mean())
    for _ in range(ITERATIONS):
        values, axes = np.linalg.eigh((vectors * weights[:, None]).T @ vectors / weights.sum())
        weights = 1 / np.sqrt((vectors @ axes[:, 0]) ** 2 + noise)
    least, next_larger, _ = values + LEVEL_NOISE * values.sum()
    return axes[:, 0], float(least / next_larger)


def _centred(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Nine tenths of the points, those nearest to their median, from their mean."""
    sampled = points[:: -(-len(points) // MOST_SAMPLED)]
    away = sampled - np.median(sampled, axis=0)
    distance = (away**2).sum(axis=1)
    near = away[distance <= np.quantile(distance, 0.9)]
    centred: NDArray[np.float64] = near - near.mean(axis=0)
    return centred
