"""How many views show a place, by the sparse points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from clsplat.covisibility.source_views import projected_points

if TYPE_CHECKING:
    from clsplat.scene import Scene, View


def mean_overlap(scene: Scene, views: Sequence[View]) -> float:
    """The number of pixels of all views over that of the places that they show.

    A sparse point stands for the pixels around it, and these show the same place as the pixels of
    all other views whose image contains the point: that is the harmonic mean, over the pixels, of
    the number of views that show a place. Occlusion is not tested, and there are fewer observations
    of a point than views that show it, as features are not found in all.

    Parameters
    ----------
    scene : the scene of these views.
    views : such as one part of `scene.split`.

    Returns
    -------
    At least 1; nan where no view shows a sparse point.
    """
    points, point, view = projected_points(scene.points, views)
    if not len(point):
        return float("nan")
    seen_by = np.bincount(point, minlength=len(points))
    sees = np.bincount(view, minlength=len(views))
    pixels = np.array([v.camera.width * v.camera.height for v in views], float)
    pixels[sees == 0] = 0  # nothing is known of what these show
    places = (pixels[view] / sees[view] / seen_by[point]).sum()
    return float(pixels.sum() / places)
