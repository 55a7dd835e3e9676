"""Which gaussians around a block are drawn as layers, and on which side of it a view sees them.

A block's reach is a box in the coordinates of its space. The planes of its sides divide the rest of
space into parts, in the way of a BSP tree (Fuchs, Kedem and Naylor 1980, On visible surface
generation by a priori tree structures): beyond a plane that the camera is beyond too lies what is
in front of the block; beyond any other plane, what is behind it. Every ray meets what is in front,
the block and what is behind in this order, so each of them is drawn by itself. A contracted space
is curved outside of its area of interest, so there this is an approximation.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.camera import turned

if TYPE_CHECKING:
    from clsplat.gaussians import Gaussians
    from clsplat.partition.region import Region
    from clsplat.scene import Scene

# A surrounding gaussian that enters a block's reach by so many of its standard deviations is drawn
# with the block. With more of them, views resemble those of the whole model less, as each is then
# drawn before or after layers to which it belongs.
HELD_DEVIATIONS = 1.0

ROUNDING = 1e-6  # of a gaussian's extent, which is computed in two ways

PARTS_OF_AXES = np.array([9, 3, 1])  # the planes of the reach divide space into 27 parts
SIDES = np.indices((3, 3, 3)).reshape(3, -1).T  # [27, 3]: of each part along each axis


def enters_reach(scene: Scene, gaussians: Gaussians, deviations: float = HELD_DEVIATIONS
                 ) -> NDArray[np.bool_]:
    """Which gaussians enter what a block reaches, as bool[N].

    A gaussian enters if the box around its ellipsoid, along the axes of the block's space, contains
    the point of the reach that is next to its centre.

    Parameters
    ----------
    scene : the block's scene.
    gaussians : in the local frame of the scene.
    deviations : standard deviations at which the ellipsoid ends.
    """
    region = _region_of(scene)
    grown, space = region.grown(region.margin), region.space
    entering = scene.reached(gaussians.positions)
    outside = np.flatnonzero(~entering)
    centres = scene.offset + scene.unit * gaussians.positions[outside].astype(np.float64)
    ends = (0.0, 1.0) if space.contracted else (-np.inf, np.inf)
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        next_to = space.world(np.clip(space.to(centres), np.maximum(grown.low, ends[0]),
                                      np.minimum(grown.high, ends[1])))
        gaps = np.abs(turned(space.rotation, next_to - centres))
    # few are so close that it matters how they are turned
    largest = np.exp(np.maximum.reduce(gaussians.log_scales[outside].T).astype(np.float64))
    close = gaps.max(axis=0) <= scene.unit * deviations * largest * (1 + ROUNDING)
    outside, gaps = outside[close], gaps[:, close]
    extents = scene.unit * deviations * deviations_along(
        gaussians.quaternions[outside], gaussians.log_scales[outside], space.rotation)
    entering[outside] = (gaps <= extents).all(axis=0)
    return entering


def deviations_along(quaternions: NDArray[np.floating], log_scales: NDArray[np.floating],
                     axes: NDArray[np.floating]) -> NDArray[np.float64]:
    """Standard deviations [A, N] of gaussians along unit vectors.

    Parameters
    ----------
    quaternions : [N, 4], as in a model.
    log_scales : [N, 3].
    axes : [A, 3], unit vectors in the frame of the gaussians.
    """
    q = quaternions.astype(np.float64).T
    w, x, y, z = q / np.sqrt((q * q).sum(axis=0)).clip(np.finfo(float).tiny)
    rotations = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]])
    along = np.einsum("ai,ijn->ajn", axes, rotations) * np.exp(log_scales.astype(np.float64).T)
    lengths: NDArray[np.float64] = np.sqrt((along * along).sum(axis=1))
    return lengths


class Sides:
    """On which sides of what a block reaches positions outside of it lie.

    Parameters
    ----------
    scene : the block's scene.
    positions : [N, 3], in the local frame of the scene.
    """

    def __init__(self, scene: Scene, positions: NDArray[np.floating]) -> None:
        self._scene, region = scene, _region_of(scene)
        self._grown, self._space = region.grown(region.margin), region.space
        places = self._place(positions.astype(np.float64))
        # along each axis: 0 below the reach, 1 within, 2 above
        side = 1 + (places >= self._grown.high).astype(np.int8) - (places < self._grown.low)
        self._part = side @ PARTS_OF_AXES

    def behind(self, camera: ArrayLike) -> NDArray[np.bool_]:
        """Which positions a camera sees behind what the block reaches, as bool[N].

        The others are in front of it, or beside it on the camera's side. A camera within the reach
        sees all behind it.

        Parameters
        ----------
        camera : [3], the camera's position, in the local frame of the scene.
        """
        low, high = self._grown.low, self._grown.high
        eye = self._place(np.asarray(camera, np.float64)[None])[0]
        distance = np.maximum(low - eye, eye - high) * self._space.half
        behind, decided = np.ones(len(SIDES), bool), np.zeros(len(SIDES), bool)
        for axis in np.argsort(-distance, kind="stable"):  # first the side that faces the camera
            for side, faces in ((0, eye[axis] < low[axis]), (2, eye[axis] >= high[axis])):
                outside = SIDES[:, axis] == side
                behind[outside & ~decided] = not faces
                decided |= outside
        seen: NDArray[np.bool_] = behind[self._part]
        return seen

    def _place(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        return self._space.to(self._scene.offset + self._scene.unit * positions)


def _region_of(scene: Scene) -> Region:
    if scene.region is None:
        raise ValueError("a scene that is not a block has no surroundings")
    return scene.region
