"""The input of a partition in world coordinates: cameras, content, and which view sees which point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.covisibility.source_views import visibility
from clsplat.errors import InputError
from clsplat.partition.region import Space

if TYPE_CHECKING:
    from clsplat.gaussians import Gaussians
    from clsplat.scene import Scene

CONTENT_QUANTILES = (0.01, 0.99)  # content beyond these counts as outliers
ANGLE_STEPS = 90  # rectangles that are tried over a quarter turn
MOST_SAMPLED = 50_000  # content points that the rectangles are tried on
RECTANGLE_QUANTILES = (0.002, 0.998)  # inside the rectangle; with fewer, corners would be cut off
LEAST_HALF_SIDE = 0.02  # of the longest half side of an area of interest


@dataclass(frozen=True, eq=False)
class PartitionInput:
    """What the partition methods work on, in world coordinates.

    Attributes
    ----------
    scene, views : the whole scene, and [V]: indices into scene.views of the training views.
    cameras : [V, 3]; the positions of these views.
    content, weights : [M, 3]; the points or gaussians that are divided among the blocks, and how
        much each counts, [M].
    points : [P, 3]; the sparse points.
    observed_points, observed_views : [S]; the pairs (point, index into `views`) in which a view
        sees a point.
    rotation : [3, 3]; rows u, v (along the ground) and up.
    """

    scene: Scene
    views: NDArray[np.integer]
    cameras: NDArray[np.float64]
    content: NDArray[np.float64]
    weights: NDArray[np.float64]
    points: NDArray[np.float64]
    observed_points: NDArray[np.integer]
    observed_views: NDArray[np.integer]
    rotation: NDArray[np.float64]

    @classmethod
    def of(cls, scene: Scene, gaussians: Gaussians | None = None, views: ArrayLike | None = None,
           up: Sequence[float] | None = None, weights: NDArray[np.float64] | None = None
           ) -> PartitionInput:
        """Collect the input of a partition; arguments and errors as for `make_partition`.

        The content is the centres of `gaussians`, or else the sparse points, each weighted by the
        number of views that see it. `up` : world; None: that of the scene."""
        indices = np.arange(len(scene.views)) if views is None else np.asarray(views)
        chosen = [scene.views[index] for index in indices]
        local, point, view = visibility(scene, chosen)
        points = world_of(scene, local)
        cameras = world_of(scene, [v.camera.position for v in chosen])
        if gaussians is None:
            content, counts = points, np.bincount(point, minlength=len(points)).astype(float)
        else:
            content = world_of(scene, gaussians.positions)
            counts = np.isfinite(content).all(axis=1).astype(float)
            if weights is not None:
                counts *= weights
        if not counts.any():
            raise InputError(f"{scene.name}: there is nothing to divide among blocks, since no "
                             "training view sees a point; reconstruct the scene again, or train a "
                             "coarse model first")
        up_world = scene.up if up is None else np.array(up) / np.linalg.norm(up)
        return cls(scene, indices, cameras, content, counts, points, point, view,
                   ground_axes(up_world, content, counts))

    def content_box(self, shares: Sequence[tuple[float, float]] = 2 * (CONTENT_QUANTILES,)
                    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The low [3] and high [3] corner, along u, v and up in world units, of what is divided.

        Along u and v these are the quantiles `shares` of the content. Along up the box contains all
        content but outliers, and all cameras.
        """
        along = self.content @ self.rotation.T
        up = np.concatenate([quantiles(along[:, 2], self.weights, CONTENT_QUANTILES),
                             self.cameras @ self.rotation[2]])
        low, high = np.transpose([quantiles(along[:, axis], self.weights, share)
                                  for axis, share in enumerate(shares)])
        return np.array([*low, up.min()]), np.array([*high, up.max()])

    def space(self, contracted: bool = False,
              shares: Sequence[tuple[float, float]] = 2 * (CONTENT_QUANTILES,),
              stretch: Sequence[float] = (1.0, 1.0)) -> Space:
        """The Space whose area of interest is `content_box(shares)`, with its sides along u and v
        multiplied by `stretch` [2]."""
        low, high = self.content_box(shares)
        half = (high - low) / 2
        half[:2] *= stretch
        half = np.maximum(half, LEAST_HALF_SIDE * max(half.max(), np.finfo(float).tiny))
        return Space(self.rotation, (low + high) / 2 @ self.rotation, half, contracted)


def world_of(scene: Scene, points: ArrayLike) -> NDArray[np.float64]:
    """The original world coordinates [N, 3] of points in the local frame of a scene."""
    return scene.offset + scene.unit * np.asarray(points, np.float64).reshape(-1, 3)


def ground_axes(up: NDArray[np.float64], content: NDArray[np.float64],
                weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """The axes u, v and up as rows [3, 3], right-handed, with u along the content's longer side.

    u and v are the sides of the smallest rectangle around the content [M, 3], without outliers and
    what has weight 0, which follows streets and flight lines; u points to the side where the
    content has its longer tail. The axes therefore rotate with the scene."""
    first = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    plane = np.stack([first, np.cross(up, first)]) / np.linalg.norm(first)
    content, weights = content[weights > 0], weights[weights > 0]
    sampled = content[::-(-len(content) // MOST_SAMPLED)]
    along = (sampled - sampled.mean(axis=0)) @ plane.T
    principal = np.linalg.eigh(along.T @ along)[1][:, 1]
    angles = (np.arctan2(principal[1], principal[0])
              + np.arange(ANGLE_STEPS) / ANGLE_STEPS * np.pi / 2)
    areas = [np.prod(np.ptp(np.quantile(along @ _rotation(angle).T, RECTANGLE_QUANTILES, axis=0),
                            axis=0)) for angle in angles]
    axes = _rotation(angles[np.argmin(areas)]) @ plane
    low, middle, high = np.transpose([quantiles(content @ axis, weights, (0.01, 0.5, 0.99))
                                      for axis in axes])
    longer = int(np.argmax(high - low))
    u = axes[longer] * (1 if high[longer] + low[longer] >= 2 * middle[longer] else -1)
    return np.stack([u, np.cross(up, u), up])


def _rotation(angle: float) -> NDArray[np.float64]:
    return np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])


def quantiles(values: NDArray[np.float64], weights: NDArray[np.float64], shares: Sequence[float]
              ) -> NDArray[np.float64]:
    """Weighted quantiles [K]: the numbers below which `shares` [K] of the weight of `values` lie.
    """
    order = np.argsort(values, kind="stable")
    weight = np.cumsum(weights[order])
    return np.interp(shares, (weight - weights[order] / 2) / weight[-1], values[order])
