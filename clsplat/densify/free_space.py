"""The space close in front of cameras, in which no photo shows anything.

Haze that stands there makes single training photos fit better and all other views worse. A coarse
run, which begins at few points, makes some; the blocks that begin with it split it further, and one
view of caliterra then lost 4 dB.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

if TYPE_CHECKING:
    from clsplat.camera import Camera
    from clsplat.scene import Scene, View

NEAREST_QUANTILE = 0.01  # of the depths of a view's points: nearer ones may be wrong matches


class FreeSpace:
    """The parts of views' frusta that are nearer than a share of their nearest sparse points.

    Parameters
    ----------
    scene : with its sparse points.
    views : of the scene; of a window of a photo, the frustum of the whole photo counts.
    share : of the depth of a view's nearest points.
    """

    def __init__(self, scene: Scene, views: Sequence[View], share: float) -> None:
        self._near_plane = scene.near_plane
        self._ends: list[tuple[Camera, float]] = []  # the depth at which each view's part ends
        for view in views:
            depths = self._shown(view.camera, scene.points)[1]
            if len(depths):
                self._ends.append((view.camera, share * np.quantile(depths, NEAREST_QUANTILE)))

    def holds(self, positions: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Which positions [N, 3], in the local frame of the scene, lie in it, as bool[N]."""
        held = np.zeros(len(positions), bool)
        tree = cKDTree(positions, balanced_tree=False, compact_nodes=False)  # quickly built
        for camera, end in self._ends:  # near most cameras there are none
            reach = end * _longest_ray(camera)
            close = np.array(tree.query_ball_point(camera.position, reach), int)
            shown, depths = self._shown(camera, positions[close].astype(np.float64))
            held[close[shown[depths < end]]] = True
        return held

    def _shown(self, camera: Camera, positions: NDArray[np.float64]
               ) -> tuple[NDArray[np.integer], NDArray[np.float64]]:
        """Which positions [N, 3] the whole photo of a camera shows, as int[M], and their depths."""
        (x, y), depths = (values.T for values in camera.project(positions))
        left, top, right, bottom = camera.borders
        shown = np.flatnonzero((depths > self._near_plane) & (x > left) & (x < right) & (y > top)
                               & (y < bottom))
        return shown, depths[shown]


def _longest_ray(camera: Camera) -> float:
    """The distance of a camera to what its whole photo shows in a corner, at depth 1."""
    low, high = np.reshape(camera.borders, (2, 2)) - camera.centre
    corner = np.maximum(np.abs(low), np.abs(high)) / camera.focal
    return float(np.sqrt(1 + corner @ corner))
